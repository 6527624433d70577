/* What pictures and depth images of a level camera are made of, for `pictures.c` (CPUs) and `pictures.cu` (GPUs): the
 * functions `columns.render_columns` and `depth.nearest_depth` in C.
 *
 * The mathematics, its order and its words are those of `coverage.py`, `camera.py`, `texture.py` and `depth.py`;
 * constants in capitals come from there, through `constants.h`. M frames, H rows, C columns.
 *
 * Whoever includes this has defined: LANES, how many pixels are drawn at a time; Lanes and Mask, their numbers and
 * whether something holds of them; FN, how functions are declared; UNROLLED, before a loop; ALIGNED, of what is read at
 * once; MEETINGS_AT_ONCE, a divisor of MEETINGS, of how many surfaces the texture is worked out in one loop over its
 * waves; FILLS_LAYERS, whether layers without a shape are filled, so that threads do not part; and lanes, store, pick,
 * lesser, greater, absolute, roots, any_of, counted, highest of Lanes.
 */

#ifndef EDQN_PICTURES_H
#define EDQN_PICTURES_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "constants.h"
#include "handler.h"

#define NOWHERE 1e30f
/* Of functions whose numbers would otherwise go to their callers through memory, or that GCC would round in another way
 * in a call of its own. */
#define INLINED __attribute__((always_inline))

FN Lanes between(Lanes x, float low, float high) { return lesser(greater(x, lanes(low)), lanes(high)); }
FN Lanes inverses(Lanes x) { return 1.0f / pick(absolute(x) < TINY, lanes(TINY), x); }

FN float least(float a, float b) { return a < b ? a : b; }
FN float most(float a, float b) { return a > b ? a : b; }
FN float inverse(float x) { return 1.0f / (fabsf(x) < TINY ? TINY : x); }

FN int is_finite(float x) {
  uint32_t bits;
  memcpy(&bits, &x, sizeof bits);
  return (bits & 0x7f800000u) != 0x7f800000u;
}

FN float not_a_number(void) {
  const uint32_t bits = 0x7fc00000u;
  float x;
  memcpy(&x, &bits, sizeof x);
  return x;
}

/* Rounds to the nearest whole number, halves to even, for |x| < 2^22. */
FN Lanes nearest_whole(Lanes x) { return (x + 12582912.0f) - 12582912.0f; }

/* ------------------------------------------------------------------------------------------- what is drawn */

typedef struct {
  int height, width, waves, tilted, across, down; /* across, down: rays a pixel, of a tilted image */
  int shadows;                                    /* whether the sun's light is kept from what is behind a shape */
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
  int patterned; /* whether shapes have surfaces of their own */
  const float *box_surface, *cylinder_surface, *sphere_surface, *plane_surface; /* [SURFACE_NUMBERS] a shape */
  int fields; /* which `fields.h` draws */
  const float *field_position, *field_surface;
} Shapes;

typedef struct {
  const float *origin, *weights; /* [3] each */
  float cos, sin, sky;
  float forward[3], right[3], up[3]; /* of the image, in the world */
  int is_finite;                     /* otherwise every pixel of a picture is NaN, as in JAX */
} Eye;

/* The ray of a column at `u` at height 0 of the image; one at height `v` has v x e->up more. */
FN void ray_ahead(const Eye* e, float u, float* ahead) {
  UNROLLED for (int i = 0; i < 3; ++i) ahead[i] = e->forward[i] + u * e->right[i];
}

FN float dot3(const float* a, const float* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

FN float shade(const Camera* c, float nx, float ny, float nz) {
  return c->ambient + (1 - c->ambient) * most(nx * c->sun[0] + ny * c->sun[1] + nz * c->sun[2], 0.0f);
}

FN Lanes shades(const Camera* c, Lanes nx, Lanes ny, Lanes nz) {
  return c->ambient + (1 - c->ambient) * greater(nx * c->sun[0] + ny * c->sun[1] + nz * c->sun[2], lanes(0));
}

/* Whether no part of an upright shape within `radius` of (x, y), relative to the eye, can be in the image. */
FN int out_of_sight(const Camera* c, const Eye* e, float x, float y, float radius) {
  const float ahead = x * e->cos + y * e->sin, right = x * e->sin - y * e->cos;
  const float edge = 0.5f * c->pitch * c->width;
  const float reach = radius * 1.0001f + 1e-3f, aslant = reach * sqrtf(1 + edge * edge);
  return ahead + reach < NEAR_M || right - edge * ahead > aslant || -right - edge * ahead > aslant;
}

/* The columns [first, last) that an interval of the image plane may touch. */
FN void columns_between(const Camera* c, float left, float right, int* first, int* last) {
  const float begin = (left - c->u[0]) / c->pitch - 1.0f, end = (right - c->u[0]) / c->pitch + 2.0f;
  /* Numbers that are not finite, which `-ffinite-math-only` lets no comparison find, are told by their bits. */
  *first = *last = 0;
  if (!is_finite(begin) || !is_finite(end)) return;
  *first = (int)least(most(begin, 0.0f), (float)c->width);
  *last = (int)least(most(end, 0.0f), (float)c->width);
}

/* --------------------------------------------------------------------- upright shapes and the columns they cover */

enum { SHARE, BOTTOM, TOP, CAP_LOW, CAP_HIGH, SIDE, SHOWN, FAR, NEAR, PER_ROW, LEAN, SHAPE, NUMBERS };

typedef struct {
  float left, right, bottom, top, cap, shown, shape;
} Extent;

FN void extent_of_box(const Eye* e, float x, float y, float hx, float hy, float cos, float sin, Extent* extent) {
  const float sign_x[4] = {1, -1, -1, 1}, sign_y[4] = {1, 1, -1, -1};
  float ahead[4], right[4];
  UNROLLED for (int i = 0; i < 4; ++i) {
    const float cx = x + cos * (sign_x[i] * hx) - sin * (sign_y[i] * hy);
    const float cy = y + sin * (sign_x[i] * hx) + cos * (sign_y[i] * hy);
    ahead[i] = cx * e->cos + cy * e->sin, right[i] = cx * e->sin - cy * e->cos;
  }
  float low = NOWHERE, high = -NOWHERE;
  UNROLLED for (int i = 0; i < 4; ++i) {
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

FN float edge_of_disc(float ahead, float right, float distance, float radius, float sine, float cosine, float sign) {
  const float f = ahead * cosine - sign * right * sine, r = right * cosine + sign * ahead * sine;
  const int in_front = f > NEAR_M * 1e-3f && distance > radius;
  return in_front ? r / most(f, NEAR_M * 1e-3f) : sign * FAR_U;
}

FN void extent_of_disc(const Eye* e, float x, float y, float radius, Extent* extent) {
  const float ahead = x * e->cos + y * e->sin, right = x * e->sin - y * e->cos;
  const float distance = sqrtf(ahead * ahead + right * right);
  const float sine = least(radius / most(distance, TINY), 1.0f), cosine = sqrtf(1 - sine * sine);
  const int behind = ahead + radius <= 0;
  extent->left = behind ? NOWHERE : edge_of_disc(ahead, right, distance, radius, sine, cosine, -1.0f);
  extent->right = behind ? -NOWHERE : edge_of_disc(ahead, right, distance, radius, sine, cosine, 1.0f);
}

FN void heights_of(const Camera* c, float middle, float half, float value, Extent* extent) {
  extent->bottom = (middle - half) / c->pitch, extent->top = (middle + half) / c->pitch;
  extent->cap = extent->top < 0 ? extent->top : most(extent->bottom, 0.0f);
  extent->shown = value * (extent->top < 0 ? shade(c, 0, 0, 1) : shade(c, 0, 0, -1));
}

/* Writes the numbers of LANES columns from the shape's depths, brightness and lean there. */
FN void write_sides(const Camera* c, const Extent* e, Lanes share, Lanes enter, Lanes leave, Lanes side, Lanes lean,
                    float* numbers, int stride) {
  const Lanes near = 1.0f / greater(enter, lanes(NEAR_M)), far = 1.0f / greater(leave, lanes(NEAR_M));
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
  store(numbers + PER_ROW * stride, lanes(inverse(e->cap)));
  store(numbers + LEAN * stride, lean * near * c->pitch);
  store(numbers + SHAPE * stride, lanes(e->shape));
}

/* The part of the columns `u` that an extent covers: its ends; returns its share of the column's width. */
FN Lanes part_covered(const Camera* c, const Extent* e, Lanes u, Lanes* low, Lanes* high) {
  const Lanes from = greater(u - c->pitch / 2, lanes(e->left)), to = lesser(u + c->pitch / 2, lanes(e->right));
  const Lanes share = greater(to - from, lanes(0)) / c->pitch;
  *low = pick(share > 0, from, u), *high = pick(share > 0, to, u);
  return share;
}

/* What columns share of an upright shape. */
typedef struct {
  int is_box, first, last; /* columns that it may cover */
  Extent extent;
  float x, y;                   /* the eye from its axis, of a box in its own frame */
  float value, x_face, y_face;  /* brightness: unlit; of the faces of a box that the eye may see */
  float fx, fy, hx, hy, corner; /* of a box, in its frame: the image's axis; halves; where its two faces meet */
  float radius;
} Upright;

/* The depths at which the rays at `u` enter and leave both pairs of side faces of a box. */
FN void slabs(const Upright* b, Lanes u, Lanes* ix, Lanes* iy, Lanes* in_x, Lanes* in_y, Lanes* out_x, Lanes* out_y) {
  *ix = inverses(b->fx + u * b->fy), *iy = inverses(b->fy - u * b->fx);
  const Lanes mx = -b->x * *ix, my = -b->y * *iy, reach_x = b->hx * absolute(*ix), reach_y = b->hy * absolute(*iy);
  *in_x = mx - reach_x, *in_y = my - reach_y, *out_x = mx + reach_x, *out_y = my + reach_y;
}

FN Mask meets_x_face(const Upright* b, Lanes u) {
  Lanes ix, iy, in_x, in_y, out_x, out_y;
  slabs(b, u, &ix, &iy, &in_x, &in_y, &out_x, &out_y);
  return in_x > in_y;
}

/* Returns whether box `n` may cover a column, and what columns share of it. */
FN int upright_box(const Camera* c, const Shapes* s, const Eye* e, int n, Upright* b) {
  const float *position = s->box_position + 3 * n, *half = s->box_half + 3 * n;
  const float ox = e->origin[0] - position[0], oy = e->origin[1] - position[1];
  b->is_box = 1, b->hx = half[0], b->hy = half[1], b->extent.shape = (float)n;
  if (out_of_sight(c, e, -ox, -oy, sqrtf(b->hx * b->hx + b->hy * b->hy))) return 0;
  const float cos = cosf(s->box_yaw[n]), sin = sinf(s->box_yaw[n]);
  extent_of_box(e, -ox, -oy, b->hx, b->hy, cos, sin, &b->extent);
  columns_between(c, b->extent.left, b->extent.right, &b->first, &b->last);
  if (b->first >= b->last) return 0;

  b->value = dot3(s->box_albedo + 3 * n, e->weights);
  heights_of(c, position[2] - e->origin[2], half[2], b->value, &b->extent);
  b->x = cos * ox + sin * oy, b->y = cos * oy - sin * ox;
  b->fx = cos * e->cos + sin * e->sin, b->fy = cos * e->sin - sin * e->cos;
  const float sx = (b->x > 0) - (b->x < 0), sy = (b->y > 0) - (b->y < 0);
  b->x_face = b->value * shade(c, sx * cos, sx * sin, 0), b->y_face = b->value * shade(c, -sy * sin, sy * cos, 0);
  const float ex = sx * b->hx - b->x, ey = sy * b->hy - b->y;
  b->corner = (ex * b->fy - ey * b->fx) * inverse(ex * b->fx + ey * b->fy);
  return 1;
}

/* Writes what the columns at `u` need of a box. */
FN void box_sides(const Camera* c, const Upright* b, Lanes u, float* numbers, int stride) {
  Lanes low, high, ix, iy, in_x, in_y, out_x, out_y;
  const Lanes share = part_covered(c, &b->extent, u, &low, &high);
  slabs(b, (low + high) / 2, &ix, &iy, &in_x, &in_y, &out_x, &out_y);
  const Lanes lean = pick(in_x > in_y, b->fy * ix, -b->fx * iy);
  const Lanes part = between((b->corner - low) * inverses(high - low), 0, 1);
  const Lanes at_low = pick(meets_x_face(b, low), lanes(b->x_face), lanes(b->y_face));
  const Lanes at_high = pick(meets_x_face(b, high), lanes(b->x_face), lanes(b->y_face));
  const Lanes side = pick(at_low == at_high, at_low, part * at_low + (1 - part) * at_high);
  write_sides(c, &b->extent, share, greater(in_x, in_y), lesser(out_x, out_y), side, lean, numbers, stride);
}

/* Returns whether cylinder `n` may cover a column, and what columns share of it. */
FN int upright_cylinder(const Camera* c, const Shapes* s, const Eye* e, int n, Upright* p) {
  const float* position = s->cylinder_position + 3 * n;
  p->is_box = 0, p->radius = s->cylinder_radius[n], p->extent.shape = (float)(s->boxes + n);
  p->x = e->origin[0] - position[0], p->y = e->origin[1] - position[1];
  if (out_of_sight(c, e, -p->x, -p->y, p->radius)) return 0;
  extent_of_disc(e, -p->x, -p->y, p->radius, &p->extent);
  columns_between(c, p->extent.left, p->extent.right, &p->first, &p->last);
  if (p->first >= p->last) return 0;
  p->value = dot3(s->cylinder_albedo + 3 * n, e->weights);
  heights_of(c, position[2] - e->origin[2], s->cylinder_half[n], p->value, &p->extent);
  return 1;
}

/* Writes what the columns at `u` need of a cylinder. */
FN void cylinder_sides(const Camera* c, const Eye* e, const Upright* p, Lanes u, float* numbers, int stride) {
  const float per_radius = 1.0f / most(p->radius, TINY);
  Lanes low, high;
  const Lanes share = part_covered(c, &p->extent, u, &low, &high);
  const Lanes at = (low + high) / 2, dx = e->cos + at * e->sin, dy = e->sin - at * e->cos;
  const Lanes a = dx * dx + dy * dy, middle = -(p->x * dx + p->y * dy) / a;
  const Lanes px = p->x + middle * dx, py = p->y + middle * dy, inside = p->radius * p->radius - (px * px + py * py);
  const Lanes reach = roots(greater(inside, lanes(0)) / a), enter = middle - reach;
  const Lanes nx = (p->x + enter * dx) * per_radius, ny = (p->y + enter * dy) * per_radius;
  const Lanes lean = (nx * e->sin - ny * e->cos) * inverses(nx * dx + ny * dy);
  const Lanes side = p->value * shades(c, nx, ny, lanes(0));
  write_sides(c, &p->extent, share, enter, middle + reach, side, lean, numbers, stride);
}

/* Returns whether upright shape `n`, boxes first, may cover a column, and what columns share of it. */
FN int upright(const Camera* c, const Shapes* s, const Eye* e, int n, Upright* found) {
  return n < s->boxes ? upright_box(c, s, e, n, found) : upright_cylinder(c, s, e, n - s->boxes, found);
}

/* Writes what the columns at `u` need of an upright shape (`coverage.column_sides`): NUMBERS numbers, `stride` apart. */
FN void sides(const Camera* c, const Eye* e, const Upright* from, Lanes u, float* numbers, int stride) {
  if (from->is_box)
    box_sides(c, from, u, numbers, stride);
  else
    cylinder_sides(c, e, from, u, numbers, stride);
}

/* -------------------------------------------------------------------------------------------- layers of a column */

typedef struct {
  Lanes closeness, coverage, value, slope, shape; /* shape: its number, boxes first, then cylinders, then spheres */
} Layer;

/* The nearest layers of LANES rows of a column, nearest first, and how many shapes were inserted: where they are fewer
 * than layers, the others hold nothing if FILLS_LAYERS, else what is not to be read. */
typedef struct {
  Layer layer[DEPTH_OF_LAYERS];
  int inserted;
} Layers;

FN void insert(Layers* layers, Layer added) {
  const Layer none = {lanes(0), lanes(0), lanes(0), lanes(0), lanes(0)};
  const int filled = layers->inserted++;
  if (FILLS_LAYERS && !filled) {
    layers->layer[0] = added;
    for (int k = 1; k < DEPTH_OF_LAYERS; ++k) layers->layer[k] = none;
    return;
  }
  UNROLLED for (int k = 0; k < DEPTH_OF_LAYERS; ++k) {
    if (!FILLS_LAYERS && k == filled) {
      layers->layer[k] = added;
      return;
    }
    const Layer old = layers->layer[k];
    const Mask nearer = added.closeness > old.closeness;
    const Layer front = {pick(nearer, added.closeness, old.closeness), pick(nearer, added.coverage, old.coverage),
                         pick(nearer, added.value, old.value), pick(nearer, added.slope, old.slope),
                         pick(nearer, added.shape, old.shape)};
    const Layer back = {pick(nearer, old.closeness, added.closeness), pick(nearer, old.coverage, added.coverage),
                        pick(nearer, old.value, added.value), pick(nearer, old.slope, added.slope),
                        pick(nearer, old.shape, added.shape)};
    layers->layer[k] = front, added = back;
  }
}

/* Adds one shape, whose numbers of this column are `stride` apart, to the layers of the LANES rows from `first` on. */
FN void insert_side(const Camera* c, const float* n, int stride, int first, Layers* layers) {
  const float bottom = n[BOTTOM * stride], top = n[TOP * stride];
  const float cap_low = n[CAP_LOW * stride], cap_high = n[CAP_HIGH * stride];
  const float highest = c->height / 2.0f - 0.5f, above = highest - first + 0.5f, below = above - LANES;
  if (most(top, cap_high) <= below || least(bottom, cap_low) >= above) return;
  const Lanes row = (highest - first) - counted(), upper = row + 0.5f, lower = row - 0.5f;
  const Lanes of_side = greater(lesser(lanes(top), upper) - greater(lanes(bottom), lower), lanes(0));
  const Lanes of_cap = greater(lesser(lanes(cap_high), upper) - greater(lanes(cap_low), lower), lanes(0));
  const Lanes coverage = (of_side + of_cap) * n[SHARE * stride];
  const Lanes closeness = between(row * n[PER_ROW * stride], n[FAR * stride], n[NEAR * stride]);
  const Layer added = {pick(coverage > 0, closeness, lanes(0)), coverage,
                       of_side * n[SIDE * stride] + of_cap * n[SHOWN * stride],
                       pick(of_cap > of_side, lanes(LEVEL_FACE), lanes(n[LEAN * stride])), lanes(n[SHAPE * stride])};
  insert(layers, added);
}

/* Adds sphere `n` to the layers of the LANES rows at heights `high` of a column. */
FN void insert_sphere(const Camera* c, const Shapes* s, const Eye* e, int n, const float* ahead, Lanes high,
                      Layers* layers) {
  const float *position = s->sphere_position + 3 * n, radius = s->sphere_radius[n];
  const float ox = e->origin[0] - position[0], oy = e->origin[1] - position[1], oz = e->origin[2] - position[2];
  const Lanes dx = ahead[0] + e->up[0] * high, dy = ahead[1] + e->up[1] * high, dz = ahead[2] + e->up[2] * high;
  const Lanes a = dx * dx + dy * dy + dz * dz;
  const Lanes nearest = -(ox * dx + oy * dy + oz * dz) / a;
  const Lanes px = ox + nearest * dx, py = oy + nearest * dy, pz = oz + nearest * dz;
  const Lanes miss2 = px * px + py * py + pz * pz, miss = roots(miss2);
  const Lanes pixel = greater(nearest, lanes(NEAR_M)) * c->pitch, size = radius / pixel;
  const Lanes whole = lesser(3.14159265f * size * size, lanes(1));
  const Lanes part = lesser(greater(0.5f + (radius - miss) / pixel, lanes(0)), whole);
  const Lanes coverage = pick(nearest > 0, part, lanes(0));
  if (!any_of(coverage > 0)) return;
  const float value = dot3(s->sphere_albedo + 3 * n, e->weights);
  const Lanes depth = nearest - roots(greater(radius * radius - miss2, lanes(0)) / a);
  const Lanes per_miss = 1.0f / greater(greater(miss, lanes(radius)), lanes(TINY));
  const Lanes bright =
      value * shades(c, (ox + depth * dx) * per_miss, (oy + depth * dy) * per_miss, (oz + depth * dz) * per_miss);
  const Layer added = {pick(coverage > 0, 1.0f / greater(depth, lanes(NEAR_M)), lanes(0)), coverage, coverage * bright,
                       lanes(0), lanes((float)(s->boxes + s->cylinders + n))};
  insert(layers, added);
}

/* How an upright shape is turned about its axis. */
typedef struct {
  float cos, sin;
} Turn;

#include "shadows.h"

/* ------------------------------------------------------------------------------------------------------- texture */

#define MOST_WAVES 8

/* What all pixels of a frame share of each wave of the texture. */
typedef struct ALIGNED {
  float k[3], weight, at_origin, right, up, per_high;
} Wave;

FN void waves_of(const Camera* c, const Eye* e, Wave* waves) {
  for (int i = 0; i < c->waves; ++i) {
    const float* k = c->wave + 4 * i;
    const float right = dot3(k, e->right), up = dot3(k, e->up);
    const Wave wave = {{k[0], k[1], k[2]}, k[3], dot3(k, e->origin), right * c->pitch, up * c->pitch, up};
    waves[i] = wave;
  }
}

FN Lanes box_filter(Lanes cycles) {
  const Lanes x = lesser(cycles * cycles, lanes(1));
  return (1.0f - x) * (1.0f - 0.55f * x);
}

/* The depth at which LANES rays meet a surface, and by how much it grows a pixel further right and up. */
typedef struct {
  Lanes depth, right, up;
} Meeting;

#define MEETINGS (DEPTH_OF_LAYERS + 1) /* with layers, and with what is behind them */

/* Writes the texture's factor on LANES rows, at heights `high`, of a column at those meetings whose bit of `wanted` is
 * set. `phases`: of each wave, by how many periods a metre of depth it changes at height 0, or null. */
FN void textures(const Camera* c, const Wave* waves, const float* ahead, const float* phases, Lanes high,
                 const Meeting* at, unsigned wanted, Lanes* factor) {
  UNROLLED for (int k = 0; k < MEETINGS; ++k) factor[k] = lanes(0);
  UNROLLED for (int from = 0; from < MEETINGS; from += MEETINGS_AT_ONCE) {
    if (!(wanted >> from & ((1u << MEETINGS_AT_ONCE) - 1))) continue;
    for (int i = 0; i < c->waves; ++i) {
      const Wave* w = &waves[i];
      const Lanes along = (phases ? phases[i] : dot3(w->k, ahead)) + w->per_high * high;
      UNROLLED for (int k = from; k < from + MEETINGS_AT_ONCE; ++k) {
        if (!(wanted >> k & 1)) continue;
        const Lanes phase = w->at_origin + at[k].depth * along, f = phase - nearest_whole(phase);
        const Lanes left = box_filter(at[k].depth * w->right + at[k].right * along) *
                           box_filter(at[k].depth * w->up + at[k].up * along);
        factor[k] += w->weight * left * (f * (8.0f - 16.0f * absolute(f)));
      }
    }
  }
  UNROLLED for (int k = 0; k < MEETINGS; ++k) factor[k] = 1.0f + c->contrast * factor[k];
}

/* ------------------------------------------------------------------------------------------------------- surfaces */

#include "patterns.h"

/* The pattern of shape `n`: boxes, cylinders, spheres, planes, fields. */
FN Pattern pattern_of_shape(const Camera* c, const Shapes* s, const Eye* e, int n) {
  const int counts[5] = {s->boxes, s->cylinders, s->spheres, s->planes, s->fields};
  const float* places[5] = {s->box_position, s->cylinder_position, s->sphere_position, s->plane_position,
                            s->field_position};
  const float* surfaces[5] = {s->box_surface, s->cylinder_surface, s->sphere_surface, s->plane_surface,
                              s->field_surface};
  float right[3], up[3];
  UNROLLED for (int i = 0; i < 3; ++i) right[i] = e->right[i] * c->pitch, up[i] = e->up[i] * c->pitch;
  int kind = 0;
  while (kind < 4 && n >= counts[kind]) n -= counts[kind++];
  return pattern_of(surfaces[kind] + SURFACE_NUMBERS * n, places[kind] + 3 * n, e->origin, right, up, e->up);
}

/* Returns the relative albedo of the shapes that LANES rays meet, 1 where their number is negative. Patterns that were
 * found are kept in `known`, by shape, where that is not null. */
FN Lanes albedo_of(const Camera* c, const Shapes* s, const Eye* e, Pattern* known, const Sight* sight, Lanes shape) {
  Lanes factor = lanes(1);
  for (float n = highest(shape); n >= 0; n = highest(shape)) {
    Pattern one, *p = known ? &known[(int)n] : &one;
    if (!known || p->kind == UNKNOWN) *p = pattern_of_shape(c, s, e, (int)n);
    const Lanes found = relative_albedo(sight, p);
    if (!any_of(shape != n)) return found;
    factor = pick(shape == n, found, factor), shape = pick(shape == n, lanes(-1), shape);
  }
  return factor;
}

/* ------------------------------------------------------------------------------------------------- ground and sky */

/* What all pixels of a frame share of a plane. */
typedef struct {
  float normal[3], height; /* of the eye above it */
  float per_high, across, along, spread, value;
} Plane;

FN void planes_of(const Camera* c, const Shapes* s, const Eye* e, Plane* planes) {
  for (int n = 0; n < s->planes; ++n) {
    const float *normal = s->plane_normal + 3 * n, *at = s->plane_position + 3 * n;
    Plane* p = &planes[n];
    const float above[3] = {e->origin[0] - at[0], e->origin[1] - at[1], e->origin[2] - at[2]};
    p->normal[0] = normal[0], p->normal[1] = normal[1], p->normal[2] = normal[2];
    p->height = dot3(above, normal), p->per_high = dot3(normal, e->up);
    p->across = dot3(normal, e->right) * c->pitch, p->along = p->per_high * c->pitch;
    p->spread = fabsf(p->across) + fabsf(p->along);
  }
}

/* Their brightness, which depth images do without. */
FN void light_planes(const Camera* c, const Shapes* s, const Eye* e, Plane* planes) {
  for (int n = 0; n < s->planes; ++n)
    planes[n].value = shade(c, planes[n].normal[0], planes[n].normal[1], planes[n].normal[2]) *
                      dot3(s->plane_albedo + 3 * n, e->weights);
}

/* Where LANES rays of a column, at heights `high`, meet ground or another plane; its brightness without
 * texture, which share of the pixels it covers, and which it is, or -1. */
FN void meet_planes(const Plane* planes, int count, const float* ahead, Lanes high, Meeting* at, Lanes* shown,
                    Lanes* share, Lanes* which) {
  const Meeting none = {lanes(NOWHERE), lanes(0), lanes(0)};
  *at = none, *shown = lanes(0), *share = lanes(0), *which = lanes(-1);
  for (int n = 0; n < count; ++n) {
    const Plane* p = &planes[n];
    const Lanes approach = dot3(p->normal, ahead) + p->per_high * high;
    const Lanes part = between(0.5f - approach * inverse(p->spread), 0, 1);
    const Lanes middle = (approach - p->spread / 2 + lesser(approach + p->spread / 2, lanes(0))) / 2;
    const Lanes per_middle = inverses(middle), t = -p->height * per_middle, relative = -t * per_middle;
    const Mask seen = (middle < 0) & (t > 0) & (t < HORIZON_M) & (t < at->depth);
    *share = pick(seen, part, *share), *shown = pick(seen, lanes(p->value), *shown);
    at->depth = pick(seen, t, at->depth), *which = pick(seen, lanes((float)n), *which);
    at->right = pick(seen, relative * p->across, at->right), at->up = pick(seen, relative * p->along, at->up);
  }
  at->depth = pick(*share > 0, at->depth, lanes(0));
}

/* Coverage from which on what lies behind is not seen: 1 but for rounding. */
#define WHOLE (1 - 1e-6f)

/* Writes what `textures` does, of shapes with surfaces of their own; `plane`: numbers of the planes behind layers. */
FN void surfaces(const Camera* c, const Shapes* s, const Eye* e, Pattern* known, const float* ahead, Lanes high,
                 const Meeting* at, const Layers* layers, unsigned wanted, Lanes plane, Lanes* factor) {
  const int others = s->boxes + s->cylinders + s->spheres;
  UNROLLED for (int k = 0; k < MEETINGS; ++k) {
    if (!(wanted >> k & 1)) continue;
    const Sight sight = {ahead, high, at[k]};
    const Lanes shape = k < DEPTH_OF_LAYERS ? pick(layers->layer[k].closeness > 0, layers->layer[k].shape, lanes(-1))
                                            : pick(plane >= 0, plane + (float)others, lanes(-1));
    factor[k] = albedo_of(c, s, e, known, &sight, shape);
  }
}

/* Blends the layers of LANES rows over planes and the sky. `casters`: what casts shadows, or null; `phases`: as in
 * `textures`. */
FN INLINED Lanes blend(const Camera* c, const Shapes* s, const Plane* planes, const Eye* e, const Wave* waves,
                       Pattern* known, const Caster* casters, const float* ahead, const float* phases, Lanes high,
                       const Layers* layers) {
  const int used = layers->inserted < DEPTH_OF_LAYERS ? layers->inserted : DEPTH_OF_LAYERS;
  int visible = 0, hidden = 0; /* layers before, and with, the first that covers all that lies behind it */
  UNROLLED for (int k = 0; k < DEPTH_OF_LAYERS; ++k) if (k < used && !hidden)
      visible = k + 1,
      hidden = !any_of(layers->layer[k].coverage < WHOLE);

  const Meeting nowhere = {lanes(0), lanes(0), lanes(0)};
  Meeting at[MEETINGS];
  UNROLLED for (int k = 0; k < MEETINGS; ++k) at[k] = nowhere;
  Lanes factor[MEETINGS], shown = lanes(0), share = lanes(0), plane = lanes(-1);
  unsigned wanted = (1u << visible) - 1;
  UNROLLED for (int k = 0; k < DEPTH_OF_LAYERS; ++k) {
    if (k >= visible) continue;
    const Layer* layer = &layers->layer[k];
    const Mask level = layer->slope == LEVEL_FACE;
    const Lanes near = pick(layer->closeness > 0, inverses(layer->closeness), lanes(0));
    at[k].depth = near, at[k].right = pick(level, lanes(0), -near * near * layer->slope);
    at[k].up = pick(level, -near * inverses(high) * c->pitch, lanes(0));
  }
  if (!hidden) {
    meet_planes(planes, s->planes, ahead, high, &at[DEPTH_OF_LAYERS], &shown, &share, &plane);
    wanted |= (unsigned)(any_of(share > 0) != 0) << DEPTH_OF_LAYERS;
  }
  if (s->patterned)
    surfaces(c, s, e, known, ahead, high, at, layers, wanted, plane, factor);
  else
    textures(c, waves, ahead, phases, high, at, wanted, factor);

  Lanes value[DEPTH_OF_LAYERS];
  UNROLLED for (int k = 0; k < DEPTH_OF_LAYERS; ++k) {
    const Layer* layer = &layers->layer[k];
    value[k] = k < visible ? layer->value : lanes(0);
    if (k < visible && c->shadows)
      value[k] = shaded(c, s, e, casters, ahead, high, at[k].depth,
                        pick(layer->closeness > 0, layer->shape, lanes(-1)), layer->coverage, value[k]);
  }
  if (c->shadows && wanted >> DEPTH_OF_LAYERS & 1) {
    const float others = (float)(s->boxes + s->cylinders + s->spheres);
    shown = shaded(c, s, e, casters, ahead, high, at[DEPTH_OF_LAYERS].depth,
                   pick((share > 0) & (plane >= 0), plane + others, lanes(-1)), lanes(1), shown);
  }

  Lanes behind = lanes(hidden ? 0 : e->sky);
  if (wanted >> DEPTH_OF_LAYERS & 1) behind += share * (shown * factor[DEPTH_OF_LAYERS] - behind);
  UNROLLED for (int k = DEPTH_OF_LAYERS - 1; k >= 0; --k) {
    if (k >= visible) continue;
    const Layer* layer = &layers->layer[k];
    behind += pick(layer->closeness > 0, value[k] * factor[k] - layer->coverage * behind, lanes(0));
  }
  return behind;
}

/* ------------------------------------------------------------------------------------------------------- depths */

/* Where an upright shape's middle is above the eye, and half its height; boxes come first. */
typedef struct {
  float middle, half;
} Level;

FN Level level_of(const Shapes* s, const Eye* e, int n) {
  const int is_box = n < s->boxes, i = is_box ? n : n - s->boxes;
  const Level level = {(is_box ? s->box_position[3 * i + 2] : s->cylinder_position[3 * i + 2]) - e->origin[2],
                       is_box ? s->box_half[3 * i + 2] : s->cylinder_half[i]};
  return level;
}

/* Lowers `nearest` of LANES rows to the depth at which rays are both beside an upright shape's axis, from `from` to
 * `to`, and between its bottom and its top. */
FN Lanes nearer_upright(Level level, Lanes from, Lanes to, Lanes per_z, Lanes nearest) {
  const Lanes at = level.middle * per_z, reach = level.half * absolute(per_z);
  const Lanes enter = greater(from, at - reach), leave = lesser(to, at + reach);
  return pick((enter < leave) & (enter > 0) & (enter < nearest), enter, nearest);
}

FN Turn turn_of(const Shapes* s, int n) {
  const Turn none = {1, 0};
  if (n >= s->boxes) return none;
  const Turn turn = {cosf(s->box_yaw[n]), sinf(s->box_yaw[n])};
  return turn;
}

/* Depths between which LANES rays are beside the axis of upright shape `n`; boxes come first. */
FN void beside(const Shapes* s, const Eye* e, int n, Turn turn, Lanes dx, Lanes dy, Lanes* from, Lanes* to) {
  const int is_box = n < s->boxes, i = is_box ? n : n - s->boxes;
  const float* position = is_box ? s->box_position + 3 * i : s->cylinder_position + 3 * i;
  const float x = position[0] - e->origin[0], y = position[1] - e->origin[1], cos = turn.cos, sin = turn.sin;
  if (is_box) {
    const float* half = s->box_half + 3 * n;
    const Lanes per_x = inverses(cos * dx + sin * dy), per_y = inverses(cos * dy - sin * dx);
    const Lanes middle_x = (cos * x + sin * y) * per_x, middle_y = (cos * y - sin * x) * per_y;
    const Lanes reach_x = half[0] * absolute(per_x), reach_y = half[1] * absolute(per_y);
    *from = greater(middle_x - reach_x, middle_y - reach_y), *to = lesser(middle_x + reach_x, middle_y + reach_y);
    return;
  }
  const float radius = s->cylinder_radius[i];
  const Lanes flat = greater(dx * dx + dy * dy, lanes(TINY)), middle = (x * dx + y * dy) / flat;
  const Lanes px = middle * dx - x, py = middle * dy - y, inside = radius * radius - (px * px + py * py);
  const Lanes reach = roots(greater(inside, lanes(0)) / flat);
  *from = pick(inside > 0, middle - reach, lanes(NOWHERE)), *to = pick(inside > 0, middle + reach, lanes(-NOWHERE));
}

/* Whether no part of upright shape `n` can be in the image; boxes come first. */
FN int upright_out_of_sight(const Camera* c, const Shapes* s, const Eye* e, int n) {
  const int is_box = n < s->boxes, i = is_box ? n : n - s->boxes;
  const float *at = is_box ? s->box_position + 3 * i : s->cylinder_position + 3 * i, *half = s->box_half + 3 * i;
  const float radius = is_box ? sqrtf(half[0] * half[0] + half[1] * half[1]) : s->cylinder_radius[i];
  return out_of_sight(c, e, at[0] - e->origin[0], at[1] - e->origin[1], radius);
}

/* Depths at which LANES rays along (dx, dy, dz) meet a plane; else NOWHERE. */
FN Lanes nearest_of_planes(const Shapes* s, const Plane* planes, Lanes dx, Lanes dy, Lanes dz) {
  Lanes nearest = lanes(NOWHERE);
  for (int n = 0; n < s->planes; ++n) {
    const Plane* p = &planes[n];
    const Lanes ahead = p->normal[0] * dx + p->normal[1] * dy;
    const Lanes approach = ahead + p->normal[2] * dz, t = -p->height * inverses(approach);
    nearest = pick((approach < 0) & (t > 0) & (t < HORIZON_M) & (t < nearest), t, nearest);
  }
  return nearest;
}

/* Lowers `nearest` of LANES rays along (dx, dy, dz) to the depth at which they meet sphere `n`. */
FN Lanes nearer_sphere(const Shapes* s, const Eye* e, int n, Lanes dx, Lanes dy, Lanes dz, Lanes nearest) {
  const float *at = s->sphere_position + 3 * n, radius = s->sphere_radius[n];
  const float ox = e->origin[0] - at[0], oy = e->origin[1] - at[1], oz = e->origin[2] - at[2];
  const Lanes a = dx * dx + dy * dy + dz * dz, middle = -(ox * dx + oy * dy + oz * dz) / a;
  const Lanes px = ox + middle * dx, py = oy + middle * dy, pz = oz + middle * dz;
  const Lanes miss2 = px * px + py * py + pz * pz;
  const Lanes t = middle - roots(greater(radius * radius - miss2, lanes(0)) / a);
  return pick((roots(miss2) < radius) & (t > 0) & (t < nearest), t, nearest);
}

/* Depths at which LANES rays along (dx, dy, dz) meet a plane or a sphere; else NOWHERE. */
FN Lanes nearest_of_others(const Shapes* s, const Plane* planes, const Eye* e, Lanes dx, Lanes dy, Lanes dz) {
  Lanes nearest = nearest_of_planes(s, planes, dx, dy, dz);
  for (int n = 0; n < s->spheres; ++n) nearest = nearer_sphere(s, e, n, dx, dy, dz, nearest);
  return nearest;
}

/* -------------------------------------------------------------------------------------------------------- frames */

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
  LIGHT = PLANES + 3, /* from here on of pictures alone */
  SURFACES = LIGHT + 1,
  WEIGHTS = SURFACES + 4,
  OPERANDS
};

/* The frames of one call. From ORIGIN on operands have a leading [L], of which each row serves M / L frames in a row.
 */
typedef struct {
  const float* data[OPERANDS];
  int64_t size[OPERANDS]; /* of a row */
  uint32_t serves[OPERANDS], frames;
  int height, width, waves, boxes, cylinders, spheres, planes, patterned;
  float* pictures;
} Batch;

/* What frame `m` reads of an operand. */
FN const float* of_frame(const Batch* b, int operand, uint32_t m) {
  return b->data[operand] + m / b->serves[operand] * b->size[operand];
}

/* A frame that reads `of`, a pointer an operand. */
FN void frame_of(const Batch* b, const float* const* of, Camera* c, Shapes* s, Eye* e) {
  const float *k = of[CONSTANTS], *r = of[ROTATION], scale = 1.0f / sqrtf(most(r[0] * r[0] + r[3] * r[3], TINY));
  c->height = b->height, c->width = b->width, c->waves = b->waves;
  const float* light = of[LIGHT];
  c->tilted = k[2] != 0, c->pitch = k[0], c->contrast = k[1], c->across = (int)k[3], c->down = (int)k[4];
  c->shadows = k[5] != 0;
  if (light) c->ambient = light[0], c->sun = light + 1, c->sky = light + 4;
  c->u = of[U], c->v = of[V], c->wave = of[WAVES];
  s->boxes = b->boxes, s->cylinders = b->cylinders, s->spheres = b->spheres, s->planes = b->planes;
  s->box_position = of[BOXES], s->box_half = of[BOXES + 1], s->box_yaw = of[BOXES + 2], s->box_albedo = of[BOXES + 3];
  s->cylinder_position = of[CYLINDERS], s->cylinder_radius = of[CYLINDERS + 1];
  s->cylinder_half = of[CYLINDERS + 2], s->cylinder_albedo = of[CYLINDERS + 3];
  s->sphere_position = of[SPHERES], s->sphere_radius = of[SPHERES + 1], s->sphere_albedo = of[SPHERES + 2];
  s->plane_position = of[PLANES], s->plane_normal = of[PLANES + 1], s->plane_albedo = of[PLANES + 2];
  s->patterned = b->patterned;
  s->box_surface = of[SURFACES], s->cylinder_surface = of[SURFACES + 1];
  s->sphere_surface = of[SURFACES + 2], s->plane_surface = of[SURFACES + 3];
  s->fields = 0, s->field_position = s->field_surface = 0;
  e->origin = of[ORIGIN], e->weights = of[WEIGHTS], e->cos = r[0] * scale, e->sin = r[3] * scale;
  e->sky = of[WEIGHTS] ? dot3(c->sky, e->weights) : 0;
  const float forward[3] = {e->cos, e->sin, 0}, right[3] = {e->sin, -e->cos, 0}, up[3] = {0, 0, 1};
  UNROLLED for (int i = 0; i < 3; ++i) {
    e->forward[i] = c->tilted ? r[3 * i] : forward[i], e->right[i] = c->tilted ? -r[3 * i + 1] : right[i];
    e->up[i] = c->tilted ? r[3 * i + 2] : up[i];
  }
  e->is_finite = 1;
  UNROLLED for (int i = 0; i < 3; ++i)
    e->is_finite &= is_finite(e->origin[i]) & is_finite(e->forward[i]) & is_finite(e->right[i]) & is_finite(e->up[i]);
}

/* Number of operands of pictures, or of depth images, which end before LIGHT. */
static inline int operands_of(int weighted) { return weighted ? OPERANDS : LIGHT; }

/* Reads a call of XLA's into a batch; returns an error for XLA to raise, or 0. `more`: operands that the caller reads. */
static inline XLA_FFI_Error* batch_of(XLA_FFI_CallFrame* call, int weighted, int more, Batch* b) {
  const int operands = operands_of(weighted);
  if (call->args.size != operands + more || call->rets.size != 1)
    return failed(call, XLA_FFI_Error_Code_INVALID_ARGUMENT,
                  "pictures were asked for with a number of operands that the library does not know; native.py must "
                  "give those of the enum in pictures.h");
  XLA_FFI_Buffer** arg = (XLA_FFI_Buffer**)call->args.args;
  const XLA_FFI_Buffer* pictures = (const XLA_FFI_Buffer*)call->rets.rets[0];
  memset(b, 0, sizeof *b);
  if (!pictures->dims[0]) return 0;
  b->frames = (uint32_t)pictures->dims[0], b->height = (int)pictures->dims[1], b->width = (int)pictures->dims[2];
  b->pictures = (float*)pictures->data;
  for (int i = 0; i < OPERANDS; ++i) b->serves[i] = 1;
  for (int i = 0; i < operands; ++i) {
    b->data[i] = (const float*)arg[i]->data;
    if (i < ORIGIN) continue;
    b->size[i] = 1, b->serves[i] = b->frames / (uint32_t)arg[i]->dims[0];
    for (int d = 1; d < arg[i]->rank; ++d) b->size[i] *= arg[i]->dims[d];
  }
  b->waves = (int)arg[WAVES]->dims[0];
  b->boxes = (int)arg[BOXES]->dims[1], b->cylinders = (int)arg[CYLINDERS]->dims[1];
  b->spheres = (int)arg[SPHERES]->dims[1], b->planes = (int)arg[PLANES]->dims[1];
  for (int i = SURFACES; weighted && i < WEIGHTS; ++i) b->patterned |= arg[i]->dims[1] > 0;
  if (b->waves > MOST_WAVES)
    return failed(call, XLA_FFI_Error_Code_INVALID_ARGUMENT,
                  "pictures have a texture of at most 8 waves; texture.WAVES must not have more");
  if (b->planes > MOST_PLANES)
    return failed(call, XLA_FFI_Error_Code_INVALID_ARGUMENT,
                  "pictures have at most 8 planes; native.can_render must refuse more");
  return 0;
}

#endif
