/* Pictures and depth images of a level camera, for CPUs: the functions `columns.pictures` and `depth.nearest_depth` in
 * C, as handlers of XLA's foreign function interface (`native.py` compiles and registers them).
 *
 * A column is drawn at a time, since few shapes cover one, and of its rows LANES at a time, in vectors as GCC and Clang
 * have them for any processor. The mathematics, its order and its words are those of `coverage.py`, `camera.py`,
 * `texture.py` and `depth.py`; constants in capitals that are not defined here come from there. M frames, H rows, C
 * columns.
 */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#ifdef __AVX__
#include <immintrin.h>
#endif

#include "handler.h"

#define LANES 8
#define NOWHERE 1e30f

typedef float Lanes __attribute__((vector_size(4 * LANES)));
typedef float Loose __attribute__((vector_size(4 * LANES), aligned(4))); /* the same anywhere in memory */
typedef int32_t Mask __attribute__((vector_size(4 * LANES)));            /* of comparisons: -1 where they hold */
typedef int64_t Pairs __attribute__((vector_size(4 * LANES)));

static inline Lanes all(float x) { return x - (Lanes){0}; }
static inline Lanes load(const float* from) { return *(const Loose*)from; }
static inline void store(float* to, Lanes x) { *(Loose*)to = x; }
static inline Lanes pick(Mask where, Lanes a, Lanes b) { return (Lanes)((where & (Mask)a) | (~where & (Mask)b)); }
#ifdef __AVX__ /* one instruction, which compilers do not find by themselves */
static inline Lanes lesser(Lanes a, Lanes b) { return (Lanes)_mm256_min_ps((__m256)a, (__m256)b); }
static inline Lanes greater(Lanes a, Lanes b) { return (Lanes)_mm256_max_ps((__m256)a, (__m256)b); }
#else
static inline Lanes lesser(Lanes a, Lanes b) { return pick(a < b, a, b); }
static inline Lanes greater(Lanes a, Lanes b) { return pick(a > b, a, b); }
#endif
static inline Lanes between(Lanes x, float low, float high) { return lesser(greater(x, all(low)), all(high)); }
static inline Lanes absolute(Lanes x) { return (Lanes)((Mask)x & 0x7fffffff); }
static inline Lanes inverses(Lanes x) { return 1.0f / pick(absolute(x) < TINY, all(TINY), x); }

static inline Lanes roots(Lanes x) {
  for (int l = 0; l < LANES; ++l) x[l] = sqrtf(x[l]);
  return x;
}

static inline int any(Mask where) {
  const Pairs two = (Pairs)where;
  int64_t found = 0;
  for (int l = 0; l < LANES / 2; ++l) found |= two[l];
  return found != 0;
}

static inline float least(float a, float b) { return a < b ? a : b; }
static inline float most(float a, float b) { return a > b ? a : b; }
static inline float inverse(float x) { return 1.0f / (fabsf(x) < TINY ? TINY : x); }

static inline int is_finite(float x) {
  uint32_t bits;
  memcpy(&bits, &x, sizeof bits);
  return (bits & 0x7f800000u) != 0x7f800000u;
}

/* Rounds to the nearest whole number, halves to even, for |x| < 2^22. */
static inline Lanes nearest_whole(Lanes x) { return (x + 12582912.0f) - 12582912.0f; }

/* ------------------------------------------------------------------------------------------- what is drawn */

typedef struct {
  int height, width, waves;
  float pitch, contrast, ambient;
  const float *sun, *sky; /* [3] each */
  const float *u, *v;     /* [C], [H] middles of pixels in the image plane */
  const float* wave;      /* [waves, 4] direction in periods a metre, and weight */
} Camera;

typedef struct {
  int boxes, cylinders, spheres, planes;
  const float *box_position, *box_half, *box_yaw, *box_albedo;
  const float *cylinder_position, *cylinder_radius, *cylinder_half, *cylinder_albedo;
  const float *sphere_position, *sphere_radius, *sphere_albedo;
  const float *plane_position, *plane_normal, *plane_albedo;
} Shapes;

typedef struct {
  const float *origin, *weights; /* [3] each */
  float cos, sin;
} Eye;

static inline float dot3(const float* a, const float* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static inline float shade(const Camera* c, float nx, float ny, float nz) {
  return c->ambient + (1 - c->ambient) * most(nx * c->sun[0] + ny * c->sun[1] + nz * c->sun[2], 0.0f);
}

static inline Lanes shades(const Camera* c, Lanes nx, Lanes ny, Lanes nz) {
  return c->ambient + (1 - c->ambient) * greater(nx * c->sun[0] + ny * c->sun[1] + nz * c->sun[2], all(0));
}

/* Whether no part of an upright shape within `radius` of (x, y), relative to the eye, can be in the image. */
static int out_of_sight(const Camera* c, const Eye* e, float x, float y, float radius) {
  const float ahead = x * e->cos + y * e->sin, right = x * e->sin - y * e->cos;
  const float edge = 0.5f * c->pitch * c->width;
  const float reach = radius * 1.0001f + 1e-3f, aslant = reach * sqrtf(1 + edge * edge);
  return ahead + reach < NEAR_M || right - edge * ahead > aslant || -right - edge * ahead > aslant;
}

/* The columns [first, last) that an interval of the image plane may touch. */
static void columns_between(const Camera* c, float left, float right, int* first, int* last) {
  const float begin = (left - c->u[0]) / c->pitch - 1.0f, end = (right - c->u[0]) / c->pitch + 2.0f;
  /* Numbers that are not finite, which `-ffinite-math-only` lets no comparison find, are told by their bits. */
  *first = *last = 0;
  if (!is_finite(begin) || !is_finite(end)) return;
  *first = (int)least(most(begin, 0.0f), (float)c->width);
  *last = (int)least(most(end, 0.0f), (float)c->width);
}

/* --------------------------------------------------------------------- upright shapes and the columns they cover */

enum { SHARE, BOTTOM, TOP, CAP_LOW, CAP_HIGH, SIDE, SHOWN, FAR, NEAR, PER_ROW, LEAN, NUMBERS };

/* What the pixels of a column need of a shape (`coverage.sides`), for all columns: NUMBERS arrays of `stride`. */
typedef struct {
  int first, last; /* columns that it may cover */
  float* numbers;
} Sides;

typedef struct {
  float left, right, bottom, top, cap, shown;
} Extent;

static void extent_of_box(const Eye* e, float x, float y, float hx, float hy, float cos, float sin, Extent* extent) {
  static const float sign_x[4] = {1, -1, -1, 1}, sign_y[4] = {1, 1, -1, -1};
  float ahead[4], right[4];
  for (int i = 0; i < 4; ++i) {
    const float cx = x + cos * (sign_x[i] * hx) - sin * (sign_y[i] * hy);
    const float cy = y + sin * (sign_x[i] * hx) + cos * (sign_y[i] * hy);
    ahead[i] = cx * e->cos + cy * e->sin, right[i] = cx * e->sin - cy * e->cos;
  }
  float low = NOWHERE, high = -NOWHERE;
  for (int i = 0; i < 4; ++i) {
    const int j = (i + 1) & 3;
    if (ahead[i] >= NEAR_M) {
      const float u = right[i] / ahead[i];
      low = least(low, u), high = most(high, u);
    }
    if ((ahead[i] < NEAR_M) != (ahead[j] < NEAR_M)) {
      const float share = (NEAR_M - ahead[i]) * inverse(ahead[j] - ahead[i]);
      const float u = (right[i] + share * (right[j] - right[i])) / NEAR_M;
      low = least(low, u), high = most(high, u);
    }
  }
  extent->left = low, extent->right = high;
}

static float edge_of_disc(float ahead, float right, float distance, float radius, float sine, float cosine,
                          float sign) {
  const float f = ahead * cosine - sign * right * sine, r = right * cosine + sign * ahead * sine;
  const int in_front = f > NEAR_M * 1e-3f && distance > radius;
  return in_front ? r / most(f, NEAR_M * 1e-3f) : sign * FAR_U;
}

static void extent_of_disc(const Eye* e, float x, float y, float radius, Extent* extent) {
  const float ahead = x * e->cos + y * e->sin, right = x * e->sin - y * e->cos;
  const float distance = sqrtf(ahead * ahead + right * right);
  const float sine = least(radius / most(distance, TINY), 1.0f), cosine = sqrtf(1 - sine * sine);
  const int behind = ahead + radius <= 0;
  extent->left = behind ? NOWHERE : edge_of_disc(ahead, right, distance, radius, sine, cosine, -1.0f);
  extent->right = behind ? -NOWHERE : edge_of_disc(ahead, right, distance, radius, sine, cosine, 1.0f);
}

static void heights_of(const Camera* c, float middle, float half, float value, Extent* extent) {
  extent->bottom = (middle - half) / c->pitch, extent->top = (middle + half) / c->pitch;
  extent->cap = extent->top < 0 ? extent->top : most(extent->bottom, 0.0f);
  extent->shown = value * (extent->top < 0 ? shade(c, 0, 0, 1) : shade(c, 0, 0, -1));
}

/* Writes the numbers of LANES columns from the shape's depths, brightness and lean there. */
static inline void write_sides(const Camera* c, const Extent* e, Lanes share, Lanes enter, Lanes leave, Lanes side,
                               Lanes lean, float* numbers, int stride) {
  const Lanes near = 1.0f / greater(enter, all(NEAR_M)), far = 1.0f / greater(leave, all(NEAR_M));
  const Lanes cap_near = e->cap * near, cap_far = e->cap * far;
  store(numbers + SHARE * stride, share);
  store(numbers + BOTTOM * stride, e->bottom * near);
  store(numbers + TOP * stride, e->top * near);
  store(numbers + CAP_LOW * stride, lesser(cap_near, cap_far));
  store(numbers + CAP_HIGH * stride, greater(cap_near, cap_far));
  store(numbers + SIDE * stride, side * share);
  store(numbers + SHOWN * stride, e->shown * share);
  store(numbers + FAR * stride, e->cap == 0 ? near : far);
  store(numbers + NEAR * stride, near);
  store(numbers + PER_ROW * stride, all(inverse(e->cap)));
  store(numbers + LEAN * stride, lean * near * c->pitch);
}

/* The part of the columns `u` that an extent covers: its ends; returns its share of the column's width. */
static inline Lanes part_covered(const Camera* c, const Extent* e, Lanes u, Lanes* low, Lanes* high) {
  const Lanes from = greater(u - c->pitch / 2, all(e->left)), to = lesser(u + c->pitch / 2, all(e->right));
  const Lanes share = greater(to - from, all(0)) / c->pitch;
  *low = pick(share > 0, from, u), *high = pick(share > 0, to, u);
  return share;
}

/* The faces of a box, whose eye is at (x, y) and which the axis of the image meets along (fx, fy), in its own frame. */
typedef struct {
  float x, y, fx, fy, hx, hy;
} Box;

/* The depths at which the rays at `u` enter and leave both pairs of side faces. */
static inline void slabs(const Box* b, Lanes u, Lanes* ix, Lanes* iy, Lanes* in_x, Lanes* in_y, Lanes* out_x,
                         Lanes* out_y) {
  *ix = inverses(b->fx + u * b->fy), *iy = inverses(b->fy - u * b->fx);
  const Lanes mx = -b->x * *ix, my = -b->y * *iy, reach_x = b->hx * absolute(*ix), reach_y = b->hy * absolute(*iy);
  *in_x = mx - reach_x, *in_y = my - reach_y, *out_x = mx + reach_x, *out_y = my + reach_y;
}

static inline Mask meets_x_face(const Box* b, Lanes u) {
  Lanes ix, iy, in_x, in_y, out_x, out_y;
  slabs(b, u, &ix, &iy, &in_x, &in_y, &out_x, &out_y);
  return in_x > in_y;
}

/* Writes what columns need of box `n`; returns 0 if it covers none. */
static int box_sides(const Camera* c, const Shapes* s, const Eye* e, int n, const float* u, int stride, Sides* out) {
  const float *position = s->box_position + 3 * n, *half = s->box_half + 3 * n;
  const float ox = e->origin[0] - position[0], oy = e->origin[1] - position[1], hx = half[0], hy = half[1];
  if (out_of_sight(c, e, -ox, -oy, sqrtf(hx * hx + hy * hy))) return 0;
  const float cos = cosf(s->box_yaw[n]), sin = sinf(s->box_yaw[n]);
  Extent extent;
  extent_of_box(e, -ox, -oy, hx, hy, cos, sin, &extent);
  columns_between(c, extent.left, extent.right, &out->first, &out->last);
  if (out->first >= out->last) return 0;

  const float value = dot3(s->box_albedo + 3 * n, e->weights);
  heights_of(c, position[2] - e->origin[2], half[2], value, &extent);
  const float bx = cos * ox + sin * oy, by = cos * oy - sin * ox;
  const float fx = cos * e->cos + sin * e->sin, fy = cos * e->sin - sin * e->cos;
  const float sx = (bx > 0) - (bx < 0), sy = (by > 0) - (by < 0);
  const float x_face = value * shade(c, sx * cos, sx * sin, 0), y_face = value * shade(c, -sy * sin, sy * cos, 0);
  const float ex = sx * hx - bx, ey = sy * hy - by;
  const float corner = (ex * fy - ey * fx) * inverse(ex * fx + ey * fy);

  const Box box = {bx, by, fx, fy, hx, hy};
  for (int first = out->first / LANES * LANES; first < out->last; first += LANES) {
    Lanes low, high, ix, iy, in_x, in_y, out_x, out_y;
    const Lanes share = part_covered(c, &extent, load(u + first), &low, &high);
    slabs(&box, (low + high) / 2, &ix, &iy, &in_x, &in_y, &out_x, &out_y);
    const Lanes lean = pick(in_x > in_y, fy * ix, -fx * iy);
    const Lanes part = between((corner - low) * inverses(high - low), 0, 1);
    const Lanes at_low = pick(meets_x_face(&box, low), all(x_face), all(y_face));
    const Lanes at_high = pick(meets_x_face(&box, high), all(x_face), all(y_face));
    const Lanes side = pick(at_low == at_high, at_low, part * at_low + (1 - part) * at_high);
    write_sides(c, &extent, share, greater(in_x, in_y), lesser(out_x, out_y), side, lean, out->numbers + first, stride);
  }
  return 1;
}

/* The same of cylinder `n`. */
static int cylinder_sides(const Camera* c, const Shapes* s, const Eye* e, int n, const float* u, int stride,
                          Sides* out) {
  const float *position = s->cylinder_position + 3 * n, radius = s->cylinder_radius[n];
  const float ox = e->origin[0] - position[0], oy = e->origin[1] - position[1];
  if (out_of_sight(c, e, -ox, -oy, radius)) return 0;
  Extent extent;
  extent_of_disc(e, -ox, -oy, radius, &extent);
  columns_between(c, extent.left, extent.right, &out->first, &out->last);
  if (out->first >= out->last) return 0;

  const float value = dot3(s->cylinder_albedo + 3 * n, e->weights), per_radius = 1.0f / most(radius, TINY);
  heights_of(c, position[2] - e->origin[2], s->cylinder_half[n], value, &extent);
  for (int first = out->first / LANES * LANES; first < out->last; first += LANES) {
    Lanes low, high;
    const Lanes share = part_covered(c, &extent, load(u + first), &low, &high);
    const Lanes at = (low + high) / 2, dx = e->cos + at * e->sin, dy = e->sin - at * e->cos;
    const Lanes a = dx * dx + dy * dy, middle = -(ox * dx + oy * dy) / a;
    const Lanes px = ox + middle * dx, py = oy + middle * dy, inside = radius * radius - (px * px + py * py);
    const Lanes reach = roots(greater(inside, all(0)) / a), enter = middle - reach;
    const Lanes nx = (ox + enter * dx) * per_radius, ny = (oy + enter * dy) * per_radius;
    const Lanes lean = (nx * e->sin - ny * e->cos) * inverses(nx * dx + ny * dy);
    const Lanes side = value * shades(c, nx, ny, all(0));
    write_sides(c, &extent, share, enter, middle + reach, side, lean, out->numbers + first, stride);
  }
  return 1;
}

/* -------------------------------------------------------------------------------------------- layers of a column */

typedef struct {
  Lanes closeness, coverage, value, slope;
} Layer;

/* The nearest layers of LANES rows of a column, nearest first, and how many shapes were inserted. */
typedef struct {
  Layer layer[DEPTH_OF_LAYERS];
  int inserted;
} Layers;

static inline void insert(Layers* layers, Layer new) {
  if (!layers->inserted++) {
    layers->layer[0] = new;
    for (int k = 1; k < DEPTH_OF_LAYERS; ++k) layers->layer[k] = (Layer){{0}, {0}, {0}, {0}};
    return;
  }
  for (int k = 0; k < DEPTH_OF_LAYERS; ++k) {
    const Layer old = layers->layer[k];
    const Mask nearer = new.closeness > old.closeness;
    layers->layer[k] = (Layer){pick(nearer, new.closeness, old.closeness), pick(nearer, new.coverage, old.coverage),
                               pick(nearer, new.value, old.value), pick(nearer, new.slope, old.slope)};
    new = (Layer){pick(nearer, old.closeness, new.closeness), pick(nearer, old.coverage, new.coverage),
                  pick(nearer, old.value, new.value), pick(nearer, old.slope, new.slope)};
  }
}

static inline Lanes counted(void) {
  Lanes number;
  for (int l = 0; l < LANES; ++l) number[l] = l;
  return number;
}

/* Adds one shape, whose numbers of this column are `stride` apart, to the layers of all blocks of rows. */
static void insert_side(const Camera* c, const float* n, int stride, Layers* layers) {
  const float bottom = n[BOTTOM * stride], top = n[TOP * stride];
  const float cap_low = n[CAP_LOW * stride], cap_high = n[CAP_HIGH * stride];
  const float highest = c->height / 2.0f - 0.5f;
  for (int first = 0; first < c->height; first += LANES) {
    const float above = highest - first + 0.5f, below = above - LANES;
    if (most(top, cap_high) <= below || least(bottom, cap_low) >= above) continue;
    const Lanes row = (highest - first) - counted(), upper = row + 0.5f, lower = row - 0.5f;
    const Lanes of_side = greater(lesser(all(top), upper) - greater(all(bottom), lower), all(0));
    const Lanes of_cap = greater(lesser(all(cap_high), upper) - greater(all(cap_low), lower), all(0));
    const Lanes coverage = (of_side + of_cap) * n[SHARE * stride];
    const Lanes closeness = between(row * n[PER_ROW * stride], n[FAR * stride], n[NEAR * stride]);
    const Layer new = {pick(coverage > 0, closeness, all(0)), coverage,
                       of_side * n[SIDE * stride] + of_cap * n[SHOWN * stride],
                       pick(of_cap > of_side, all(LEVEL_FACE), all(n[LEAN * stride]))};
    insert(&layers[first / LANES], new);
  }
}

/* Adds sphere `n` to the layers of the column at `u`. */
static void insert_sphere(const Camera* c, const Shapes* s, const Eye* e, int n, float u, const float* v,
                          Layers* layers) {
  const float *position = s->sphere_position + 3 * n, radius = s->sphere_radius[n];
  const float ox = e->origin[0] - position[0], oy = e->origin[1] - position[1], oz = e->origin[2] - position[2];
  const float value = dot3(s->sphere_albedo + 3 * n, e->weights);
  const float dx = e->cos + u * e->sin, dy = e->sin - u * e->cos;
  for (int first = 0; first < c->height; first += LANES) {
    const Lanes dz = load(v + first), a = dx * dx + dy * dy + dz * dz;
    const Lanes nearest = -(ox * dx + oy * dy + oz * dz) / a;
    const Lanes px = ox + nearest * dx, py = oy + nearest * dy, pz = oz + nearest * dz;
    const Lanes miss2 = px * px + py * py + pz * pz, miss = roots(miss2);
    const Lanes depth = nearest - roots(greater(radius * radius - miss2, all(0)) / a);
    const Lanes pixel = greater(nearest, all(NEAR_M)) * c->pitch, size = radius / pixel;
    const Lanes whole = lesser(3.14159265f * size * size, all(1));
    const Lanes part = lesser(greater(0.5f + (radius - miss) / pixel, all(0)), whole);
    const Lanes coverage = pick(nearest > 0, part, all(0));
    if (!any(coverage > 0)) continue;
    const Lanes per_miss = 1.0f / greater(greater(miss, all(radius)), all(TINY));
    const Lanes bright =
        value * shades(c, (ox + depth * dx) * per_miss, (oy + depth * dy) * per_miss, (oz + depth * dz) * per_miss);
    const Lanes closeness = pick(coverage > 0, 1.0f / greater(depth, all(NEAR_M)), all(0));
    insert(&layers[first / LANES], (Layer){closeness, coverage, coverage * bright, all(0)});
  }
}

/* ------------------------------------------------------------------------------------------------------- texture */

#define MOST_WAVES 8

/* What all pixels of a frame share of each wave of the texture. */
typedef struct {
  float kx, ky, kz, weight, at_origin, right, up;
} Wave;

static void waves_of(const Camera* c, const Eye* e, Wave* waves) {
  for (int i = 0; i < c->waves; ++i) {
    const float* k = c->wave + 4 * i;
    waves[i] =
        (Wave){k[0], k[1], k[2], k[3], dot3(k, e->origin), (k[0] * e->sin - k[1] * e->cos) * c->pitch, k[2] * c->pitch};
  }
}

static inline Lanes box_filter(Lanes cycles) {
  const Lanes x = lesser(cycles * cycles, all(1));
  return (1.0f - x) * (1.0f - 0.55f * x);
}

/* The texture's factor on LANES rows of a column. */
static inline Lanes texture(const Camera* c, const Wave* waves, float dx, float dy, Lanes dz, Lanes depth,
                            Lanes slope_right, Lanes slope_up) {
  Lanes total = {0};
  for (int i = 0; i < c->waves; ++i) {
    const Wave* w = &waves[i];
    const Lanes along = (w->kx * dx + w->ky * dy) + w->kz * dz, phase = w->at_origin + depth * along;
    const Lanes left =
        box_filter(depth * w->right + slope_right * along) * box_filter(depth * w->up + slope_up * along);
    const Lanes f = phase - nearest_whole(phase);
    total += w->weight * left * (f * (8.0f - 16.0f * absolute(f)));
  }
  return 1.0f + c->contrast * total;
}

/* Brightness of textured ground and other planes before the sky, LANES rows of the column along (dx, dy). */
static inline Lanes backdrop(const Camera* c, const Shapes* s, const Eye* e, const Wave* waves, float dx, float dy,
                             Lanes dz) {
  const Lanes sky = all(dot3(c->sky, e->weights));
  Lanes depth = all(NOWHERE), shown = {0}, share = {0}, slope_right = {0}, slope_up = {0};
  for (int n = 0; n < s->planes; ++n) {
    const float *normal = s->plane_normal + 3 * n, *at = s->plane_position + 3 * n;
    const float height =
        (e->origin[0] - at[0]) * normal[0] + (e->origin[1] - at[1]) * normal[1] + (e->origin[2] - at[2]) * normal[2];
    const float across = (normal[0] * e->sin - normal[1] * e->cos) * c->pitch, along = normal[2] * c->pitch;
    const float spread = fabsf(across) + fabsf(along);
    const float value = shade(c, normal[0], normal[1], normal[2]) * dot3(s->plane_albedo + 3 * n, e->weights);
    const Lanes approach = normal[0] * dx + normal[1] * dy + normal[2] * dz;
    const Lanes part = between(0.5f - approach * inverse(spread), 0, 1);
    const Lanes middle = (approach - spread / 2 + lesser(approach + spread / 2, all(0))) / 2;
    const Lanes per_middle = inverses(middle), t = -height * per_middle, relative = -t * per_middle;
    const Mask seen = (middle < 0) & (t > 0) & (t < HORIZON_M) & (t < depth);
    depth = pick(seen, t, depth), share = pick(seen, part, share), shown = pick(seen, all(value), shown);
    slope_right = pick(seen, relative * across, slope_right), slope_up = pick(seen, relative * along, slope_up);
  }
  if (!any(share > 0)) return sky;
  depth = pick(share > 0, depth, all(0));
  return sky + share * (shown * texture(c, waves, dx, dy, dz, depth, slope_right, slope_up) - sky);
}

/* Coverage from which on what lies behind is not seen: 1 but for rounding. */
#define WHOLE (1 - 1e-6f)

/* Blends the layers of LANES rows over ground and sky. */
static inline Lanes blend(const Camera* c, const Shapes* s, const Eye* e, const Wave* waves, float dx, float dy,
                          Lanes dz, const Layers* layers) {
  const int used = layers->inserted < DEPTH_OF_LAYERS ? layers->inserted : DEPTH_OF_LAYERS;
  int visible = 0; /* layers before, and with, the first that covers all that lies behind it */
  while (visible < used && any(layers->layer[visible++].coverage < WHOLE)) continue;
  const int hidden = visible > 0 && !any(layers->layer[visible - 1].coverage < WHOLE);
  Lanes behind = hidden ? all(0) : backdrop(c, s, e, waves, dx, dy, dz);
  for (int k = visible - 1; k >= 0; --k) {
    const Layer* layer = &layers->layer[k];
    const Mask met = layer->closeness > 0, level = layer->slope == LEVEL_FACE;
    const Lanes near = pick(met, inverses(layer->closeness), all(0));
    const Lanes right = pick(level, all(0), -near * near * layer->slope);
    const Lanes up = pick(level, -near * inverses(dz) * c->pitch, all(0));
    const Lanes factor = texture(c, waves, dx, dy, dz, near, right, up);
    behind += pick(met, layer->value * factor - layer->coverage * behind, all(0));
  }
  return behind;
}

/* -------------------------------------------------------------------------------------------------------- frames */

/* Memory for the frames of one call. */
typedef struct {
  float *numbers, *u, *v;
  Sides* sides;
  Extent* spheres;
  Layers* layers;
  int *covering, *found; /* shapes that cover each column, in order, and how many */
  int stride, most;
} Work;

static int rounded_up(int n) { return (n + LANES - 1) / LANES * LANES; }

static int prepare(const Camera* c, const Shapes* s, Work* w) {
  const int uprights = s->boxes + s->cylinders, rows = rounded_up(c->height);
  w->stride = rounded_up(c->width);
  w->numbers = malloc(sizeof(float) * ((size_t)uprights * NUMBERS * w->stride + 1));
  w->sides = malloc(sizeof(Sides) * (size_t)(uprights + 1));
  w->layers = aligned_alloc(_Alignof(Layers), sizeof(Layers) * (size_t)(rows / LANES));
  w->u = malloc(sizeof(float) * (size_t)(w->stride + rows));
  w->spheres = malloc(sizeof(Extent) * (size_t)(s->spheres + 1));
  w->most = uprights + 1;
  w->found = malloc(sizeof(int) * (size_t)c->width * (size_t)(w->most + 1));
  if (!w->numbers || !w->sides || !w->layers || !w->u || !w->found || !w->spheres) return 0;
  w->covering = w->found + c->width;
  w->v = w->u + w->stride;
  /* What lies beyond the image repeats its edge, so that all numbers are finite. */
  for (int i = 0; i < w->stride; ++i) w->u[i] = c->u[i < c->width ? i : c->width - 1];
  for (int i = 0; i < rows; ++i) w->v[i] = c->v[i < c->height ? i : c->height - 1];
  return 1;
}

static void release(Work* w) {
  free(w->numbers), free(w->sides), free(w->layers), free(w->u), free(w->found), free(w->spheres);
}

/* Draws one frame, [H, C]. */
static void draw(const Camera* c, const Shapes* s, const Eye* e, Work* w, float* picture) {
  Wave waves[MOST_WAVES];
  waves_of(c, e, waves);
  int visible = 0;
  for (int n = 0; n < s->boxes + s->cylinders; ++n) {
    Sides* next = &w->sides[visible];
    next->numbers = w->numbers + (size_t)visible * NUMBERS * w->stride;
    visible += n < s->boxes ? box_sides(c, s, e, n, w->u, w->stride, next)
                            : cylinder_sides(c, s, e, n - s->boxes, w->u, w->stride, next);
  }
  for (int n = 0; n < s->spheres; ++n) {
    const float* at = s->sphere_position + 3 * n;
    extent_of_disc(e, at[0] - e->origin[0], at[1] - e->origin[1], s->sphere_radius[n], &w->spheres[n]);
  }
  memset(w->found, 0, sizeof(int) * (size_t)c->width);
  for (int n = 0; n < visible; ++n)
    for (int column = w->sides[n].first; column < w->sides[n].last; ++column) {
      w->covering[column * w->most + w->found[column]] = n;
      w->found[column] += w->sides[n].numbers[SHARE * w->stride + column] > 0;
    }
  const int blocks = rounded_up(c->height) / LANES;
  for (int column = 0; column < c->width; ++column) {
    const float u = c->u[column], dx = e->cos + u * e->sin, dy = e->sin - u * e->cos;
    for (int b = 0; b < blocks; ++b) w->layers[b].inserted = 0;
    for (int n = 0; n < s->spheres; ++n) /* A silhouette fades over half a pixel on either side. */
      if (u + 1.5f * c->pitch > w->spheres[n].left && u - 1.5f * c->pitch < w->spheres[n].right)
        insert_sphere(c, s, e, n, u, w->v, w->layers);
    for (int n = 0; n < w->found[column]; ++n)
      insert_side(c, w->sides[w->covering[column * w->most + n]].numbers + column, w->stride, w->layers);
    for (int b = 0; b < blocks; ++b) {
      const Lanes behind = blend(c, s, e, waves, dx, dy, load(w->v + b * LANES), &w->layers[b]);
      for (int l = 0; l < LANES && b * LANES + l < c->height; ++l)
        picture[(b * LANES + l) * c->width + column] = behind[l];
    }
  }
}

/* Lowers `nearest` of LANES rows to the depth at which rays are both beside an upright shape's axis, from `from` to
 * `to`, and between its bottom and its top. */
static inline Lanes nearer_upright(float from, float to, float middle, float half, Lanes per_z, Lanes nearest) {
  const Lanes at = middle * per_z, reach = half * absolute(per_z);
  const Lanes enter = greater(all(from), at - reach), leave = lesser(all(to), at + reach);
  return pick((enter < leave) & (enter > 0) & (enter < nearest), enter, nearest);
}

/* Depths between which the middle rays of LANES columns are beside the axis of box or cylinder `n`, whose centre is at
 * (x, y) from the eye. */
static inline void beside(const Shapes* s, int n, float x, float y, float cos, float sin, Lanes dx, Lanes dy,
                          Lanes* from, Lanes* to) {
  if (n < s->boxes) {
    const float* half = s->box_half + 3 * n;
    const Lanes per_x = inverses(cos * dx + sin * dy), per_y = inverses(cos * dy - sin * dx);
    const Lanes middle_x = (cos * x + sin * y) * per_x, middle_y = (cos * y - sin * x) * per_y;
    const Lanes reach_x = half[0] * absolute(per_x), reach_y = half[1] * absolute(per_y);
    *from = greater(middle_x - reach_x, middle_y - reach_y), *to = lesser(middle_x + reach_x, middle_y + reach_y);
    return;
  }
  const float radius = s->cylinder_radius[n - s->boxes];
  const Lanes flat = greater(dx * dx + dy * dy, all(TINY)), middle = (x * dx + y * dy) / flat;
  const Lanes px = middle * dx - x, py = middle * dy - y, inside = radius * radius - (px * px + py * py);
  const Lanes reach = roots(greater(inside, all(0)) / flat);
  *from = pick(inside > 0, middle - reach, all(NOWHERE)), *to = pick(inside > 0, middle + reach, all(-NOWHERE));
}

/* Depth along the middle ray of every pixel of one frame, [H, C]; NOWHERE where there is nothing. */
static void measure(const Camera* c, const Shapes* s, const Eye* e, Work* w, float* picture) {
  memset(w->found, 0, sizeof(int) * (size_t)c->width);
  for (int n = 0; n < s->boxes + s->cylinders; ++n) {
    const int is_box = n < s->boxes, i = is_box ? n : n - s->boxes;
    const float* at = is_box ? s->box_position + 3 * i : s->cylinder_position + 3 * i;
    const float* half = is_box ? s->box_half + 3 * i : 0;
    const float x = at[0] - e->origin[0], y = at[1] - e->origin[1];
    const float radius = is_box ? sqrtf(half[0] * half[0] + half[1] * half[1]) : s->cylinder_radius[i];
    if (out_of_sight(c, e, x, y, radius)) continue;
    float *from = w->numbers + (size_t)n * NUMBERS * w->stride, *to = from + w->stride;
    const float cos = is_box ? cosf(s->box_yaw[i]) : 1, sin = is_box ? sinf(s->box_yaw[i]) : 0;
    for (int first = 0; first < c->width; first += LANES) {
      const Lanes u = load(w->u + first), dx = e->cos + u * e->sin, dy = e->sin - u * e->cos;
      Lanes begin, end;
      beside(s, n, x, y, cos, sin, dx, dy, &begin, &end);
      store(from + first, begin), store(to + first, end);
    }
    for (int column = 0; column < c->width; ++column) {
      w->covering[column * w->most + w->found[column]] = n;
      w->found[column] += (from[column] < to[column]) & (to[column] > 0);
    }
  }
  for (int column = 0; column < c->width; ++column) {
    const float dx = e->cos + c->u[column] * e->sin, dy = e->sin - c->u[column] * e->cos;
    for (int first = 0; first < c->height; first += LANES) {
      const Lanes dz = load(w->v + first), per_z = inverses(dz);
      Lanes nearest = all(NOWHERE);
      for (int n = 0; n < s->planes; ++n) {
        const float *normal = s->plane_normal + 3 * n, *at = s->plane_position + 3 * n;
        const float height = (e->origin[0] - at[0]) * normal[0] + (e->origin[1] - at[1]) * normal[1] +
                             (e->origin[2] - at[2]) * normal[2];
        const Lanes approach = normal[0] * dx + normal[1] * dy + normal[2] * dz, t = -height * inverses(approach);
        nearest = pick((approach < 0) & (t > 0) & (t < HORIZON_M) & (t < nearest), t, nearest);
      }
      for (int n = 0; n < s->spheres; ++n) {
        const float *at = s->sphere_position + 3 * n, radius = s->sphere_radius[n];
        const float ox = e->origin[0] - at[0], oy = e->origin[1] - at[1], oz = e->origin[2] - at[2];
        const Lanes a = dx * dx + dy * dy + dz * dz, middle = -(ox * dx + oy * dy + oz * dz) / a;
        const Lanes px = ox + middle * dx, py = oy + middle * dy, pz = oz + middle * dz;
        const Lanes miss2 = px * px + py * py + pz * pz;
        const Lanes t = middle - roots(greater(radius * radius - miss2, all(0)) / a);
        nearest = pick((roots(miss2) < radius) & (t > 0) & (t < nearest), t, nearest);
      }
      for (int k = 0; k < w->found[column]; ++k) {
        const int n = w->covering[column * w->most + k], is_box = n < s->boxes, i = is_box ? n : n - s->boxes;
        const float* from = w->numbers + (size_t)n * NUMBERS * w->stride + column;
        const float z = is_box ? s->box_position[3 * i + 2] : s->cylinder_position[3 * i + 2];
        const float half = is_box ? s->box_half[3 * i + 2] : s->cylinder_half[i];
        nearest = nearer_upright(from[0], from[w->stride], z - e->origin[2], half, per_z, nearest);
      }
      for (int l = 0; l < LANES && first + l < c->height; ++l) picture[(first + l) * c->width + column] = nearest[l];
    }
  }
}

/* ------------------------------------------------------------------------------------------------------- handlers */

enum {
  CONSTANTS,
  U,
  V,
  WAVES,
  ORIGIN,
  ROTATION,
  BOXES,
  CYLINDERS = BOXES + 4,
  SPHERES = CYLINDERS + 4,
  PLANES = SPHERES + 3,
  OPERANDS = PLANES + 3
};

/* The part of an operand that frame `m` reads. Of [L, ...] each row serves frames / L frames in a row. */
static const float* of_frame(const XLA_FFI_Buffer* operand, int64_t m, int64_t frames) {
  int64_t size = 1;
  for (int i = 1; i < operand->rank; ++i) size *= operand->dims[i];
  return (const float*)operand->data + m / (frames / operand->dims[0]) * size;
}

typedef void Render(const Camera*, const Shapes*, const Eye*, Work*, float*);

/* Renders all frames. Operands are numbered above; from ORIGIN on they have a leading [L], see `of_frame`, and last
 * come the weights [L, 3], if any. */
static XLA_FFI_Error* each_frame(XLA_FFI_CallFrame* call, Render* render, int weighted) {
  if (asked_for_version(call)) return 0;
  if (call->args.size != OPERANDS + weighted || call->rets.size != 1)
    return failed(
        call, XLA_FFI_Error_Code_INVALID_ARGUMENT,
        "pictures.c was called with a number of operands that it does not know; native.py must give those of its enum");
  XLA_FFI_Buffer** arg = (XLA_FFI_Buffer**)call->args.args;
  const XLA_FFI_Buffer* pictures = call->rets.rets[0];
  const int64_t frames = pictures->dims[0];
  const float* k = arg[CONSTANTS]->data;
  const Camera camera = {
      (int)pictures->dims[1], (int)pictures->dims[2], (int)arg[WAVES]->dims[0], k[0], k[1], k[2], k + 3, k + 6,
      arg[U]->data,           arg[V]->data,           arg[WAVES]->data};
  Shapes shapes = {.boxes = (int)arg[BOXES]->dims[1],
                   .cylinders = (int)arg[CYLINDERS]->dims[1],
                   .spheres = (int)arg[SPHERES]->dims[1],
                   .planes = (int)arg[PLANES]->dims[1]};
  if (camera.waves > MOST_WAVES)
    return failed(call, XLA_FFI_Error_Code_INVALID_ARGUMENT,
                  "pictures.c draws a texture of at most 8 waves; texture.WAVES must not have more");
  Work work = {0};
  if (!prepare(&camera, &shapes, &work)) {
    release(&work);
    return failed(call, XLA_FFI_Error_Code_RESOURCE_EXHAUSTED,
                  "pictures.c found no memory for the columns of a frame; the image must be smaller");
  }
  for (int64_t m = 0; m < frames; ++m) {
    const float* of[OPERANDS + 1] = {0};
    for (int i = ORIGIN; i < OPERANDS + weighted; ++i) of[i] = of_frame(arg[i], m, frames);
    shapes.box_position = of[BOXES], shapes.box_half = of[BOXES + 1];
    shapes.box_yaw = of[BOXES + 2], shapes.box_albedo = of[BOXES + 3];
    shapes.cylinder_position = of[CYLINDERS], shapes.cylinder_radius = of[CYLINDERS + 1];
    shapes.cylinder_half = of[CYLINDERS + 2], shapes.cylinder_albedo = of[CYLINDERS + 3];
    shapes.sphere_position = of[SPHERES], shapes.sphere_radius = of[SPHERES + 1];
    shapes.sphere_albedo = of[SPHERES + 2];
    shapes.plane_position = of[PLANES], shapes.plane_normal = of[PLANES + 1], shapes.plane_albedo = of[PLANES + 2];
    const float *r = of[ROTATION], scale = 1.0f / sqrtf(most(r[0] * r[0] + r[3] * r[3], TINY));
    const Eye eye = {of[ORIGIN], of[OPERANDS], r[0] * scale, r[3] * scale};
    render(&camera, &shapes, &eye, &work, (float*)pictures->data + m * camera.height * camera.width);
  }
  release(&work);
  return 0;
}

XLA_FFI_Error* edqn_pictures(XLA_FFI_CallFrame* call) { return each_frame(call, draw, 1); }

XLA_FFI_Error* edqn_depths(XLA_FFI_CallFrame* call) { return each_frame(call, measure, 0); }
