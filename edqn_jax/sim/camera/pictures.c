/* Pictures and depth images for CPUs, as handlers of XLA's foreign function interface (`native.py` compiles and
 * registers them). What they are made of is in `pictures.h`; those of a camera on the body, in `tilted.h`; meshes and the
 * like, in `fields.h`.
 *
 * A column is drawn at a time, since few shapes cover one, and of its rows LANES at a time, in vectors as GCC and Clang
 * have them for any processor.
 */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#ifdef __AVX__
#include <immintrin.h>
#endif

#if defined(__SSE2__) && !defined(__AVX__)
#define LANES 4
#else
#define LANES 8
#endif
#define FN static inline
#define UNROLLED
#define MEETINGS_AT_ONCE 1
#define FILLS_LAYERS 0
#define ALIGNED

typedef float Lanes __attribute__((vector_size(4 * LANES)));
typedef float Loose __attribute__((vector_size(4 * LANES), aligned(4))); /* the same anywhere in memory */
typedef int32_t Mask __attribute__((vector_size(4 * LANES)));            /* of comparisons: -1 where they hold */
typedef int64_t Pairs __attribute__((vector_size(4 * LANES)));

static inline Lanes lanes(float x) { return x - (Lanes){0}; }
static inline Lanes load(const float* from) { return *(const Loose*)from; }
static inline void store(float* to, Lanes x) { *(Loose*)to = x; }
#ifdef __AVX__ /* one instruction, which compilers do not find by themselves */
static inline Lanes pick(Mask where, Lanes a, Lanes b) {
  return (Lanes)_mm256_blendv_ps((__m256)b, (__m256)a, (__m256)where);
}
static inline Lanes lesser(Lanes a, Lanes b) { return (Lanes)_mm256_min_ps((__m256)a, (__m256)b); }
static inline Lanes greater(Lanes a, Lanes b) { return (Lanes)_mm256_max_ps((__m256)a, (__m256)b); }
#else
static inline Lanes pick(Mask where, Lanes a, Lanes b) { return (Lanes)((where & (Mask)a) | (~where & (Mask)b)); }
static inline Lanes lesser(Lanes a, Lanes b) { return pick(a < b, a, b); }
static inline Lanes greater(Lanes a, Lanes b) { return pick(a > b, a, b); }
#endif
static inline Lanes absolute(Lanes x) { return (Lanes)((Mask)x & 0x7fffffff); }

static inline Lanes roots(Lanes x) {
  for (int l = 0; l < LANES; ++l) x[l] = sqrtf(x[l]);
  return x;
}

static inline int any_of(Mask where) {
#ifdef __AVX__
  return _mm256_movemask_ps((__m256)where);
#else
  const Pairs two = (Pairs)where;
  int64_t found = 0;
  for (int l = 0; l < LANES / 2; ++l) found |= two[l];
  return found != 0;
#endif
}

static inline Lanes counted(void) {
  Lanes number;
  for (int l = 0; l < LANES; ++l) number[l] = l;
  return number;
}

static inline float highest(Lanes x) {
  float found = x[0];
  for (int l = 1; l < LANES; ++l) found = x[l] > found ? x[l] : found;
  return found;
}

#include "pictures.h"
#include "tilted.h"
#include "fields.h"

/* An upright shape that covers the columns [first, last), and its numbers: NUMBERS arrays of `stride`. */
typedef struct {
  int first, last;
  float* numbers;
} Sides;

/* -------------------------------------------------------------------------------------------------------- frames */

/* Memory for the frames of one call. */
typedef struct {
  float *numbers, *u, *v, *columns; /* columns: the image, column by column */
  Sides* sides;
  Extent* spheres;
  Layers* layers;
  Pattern* patterns; /* by shape, as the next */
  Caster* casters;
  Tilted* tilted;
  float* heights; /* of the tilted ones' faces */
  int *covering, *found; /* shapes that cover each column, in order, and how many */
  int stride, most;
  Fields fields;
} Work;

static int rounded_up(int n) { return (n + LANES - 1) / LANES * LANES; }

static int prepare(const Camera* c, const Shapes* s, Work* w) {
  const int uprights = s->boxes + s->cylinders, rows = rounded_up(c->height);
  w->stride = rounded_up(c->width);
  w->numbers = malloc(sizeof(float) * ((size_t)uprights * NUMBERS * w->stride + 1));
  w->sides = malloc(sizeof(Sides) * (size_t)(uprights + 1));
  w->layers = aligned_alloc(_Alignof(Layers), sizeof(Layers) * (size_t)(rows / LANES));
  w->u = malloc(sizeof(float) * ((size_t)w->stride + (size_t)rows + (size_t)c->width * (size_t)rows));
  w->spheres = malloc(sizeof(Extent) * (size_t)(s->spheres + 1));
  w->patterns = malloc(sizeof(Pattern) * (size_t)(uprights + s->spheres + s->planes + s->fields + 1));
  w->casters = malloc(sizeof(Caster) * (size_t)(uprights + s->spheres + 1));
  w->tilted = malloc(sizeof(Tilted) * (size_t)(uprights + 1));
  w->heights = malloc(sizeof(float) * (c->tilted ? (size_t)(uprights * HEIGHTS(1, c->across) * w->stride) + 1 : 1));
  w->most = uprights + 1;
  w->found = malloc(sizeof(int) * (size_t)c->width * (size_t)(w->most + 1));
  if (!w->numbers || !w->sides || !w->layers || !w->u || !w->found || !w->spheres) return 0;
  if (!w->patterns || !w->casters || !w->tilted || !w->heights) return 0;
  if (!prepare_fields(c, rows, s->fields, &w->fields)) return 0;
  w->covering = w->found + c->width;
  w->v = w->u + w->stride, w->columns = w->v + rows;
  /* What lies beyond the image repeats its edge, so that all numbers are finite. */
  for (int i = 0; i < w->stride; ++i) w->u[i] = c->u[i < c->width ? i : c->width - 1];
  for (int i = 0; i < rows; ++i) w->v[i] = c->v[i < c->height ? i : c->height - 1];
  return 1;
}

static void release(Work* w) {
  free(w->numbers), free(w->sides), free(w->layers), free(w->u), free(w->found), free(w->spheres);
  free(w->patterns), free(w->casters), free(w->tilted), free(w->heights), free(w->fields.ray[0]);
}

static float* column_of(const Camera* c, const Work* w, int column) {
  return w->columns + (size_t)column * rounded_up(c->height);
}

#ifdef __AVX__
/* Writes 8 rows of 8 numbers, `width` apart, from 8 columns that are `stride` apart. */
static inline void turn_block(const float* from, int stride, float* to, int width) {
  __m256 pairs[8], fours[8];
  for (int i = 0; i < 8; i += 2) {
    const __m256 even = _mm256_loadu_ps(from + i * stride), odd = _mm256_loadu_ps(from + (i + 1) * stride);
    pairs[i] = _mm256_unpacklo_ps(even, odd), pairs[i + 1] = _mm256_unpackhi_ps(even, odd);
  }
  for (int i = 0; i < 8; i += 4)
    for (int k = 0; k < 2; ++k) {
      fours[i + 2 * k] = _mm256_shuffle_ps(pairs[i + k], pairs[i + 2 + k], 0x44);
      fours[i + 2 * k + 1] = _mm256_shuffle_ps(pairs[i + k], pairs[i + 2 + k], 0xee);
    }
  for (int i = 0; i < 4; ++i) {
    _mm256_storeu_ps(to + i * width, _mm256_permute2f128_ps(fours[i], fours[i + 4], 0x20));
    _mm256_storeu_ps(to + (i + 4) * width, _mm256_permute2f128_ps(fours[i], fours[i + 4], 0x31));
  }
}
#endif

/* Writes the image [H, C] of the columns. */
static void write_rows(const Camera* c, const Work* w, float* picture) {
  const int stride = rounded_up(c->height);
  int turned = 0; /* rows of whole blocks */
#ifdef __AVX__
  if (c->width % 8 == 0)
    for (; turned + 8 <= c->height; turned += 8)
      for (int first = 0; first < c->width; first += 8)
        turn_block(w->columns + first * stride + turned, stride, picture + turned * c->width + first, c->width);
#endif
  for (int row = turned; row < c->height; ++row)
    for (int column = 0; column < c->width; ++column)
      picture[row * c->width + column] = w->columns[column * stride + row];
}

/* Writes a column of blended layers. */
FN INLINED void finish(const Camera* c, const Shapes* s, const Plane* planes, const Eye* e, const Wave* waves, Work* w,
                       const float* ahead, float* column) {
  float phases[MOST_WAVES];
  for (int i = 0; i < c->waves; ++i) phases[i] = dot3(waves[i].k, ahead);
  for (int b = 0; b < rounded_up(c->height) / LANES; ++b) {
    const Lanes high = load(w->v + b * LANES);
    store(column + b * LANES,
          blend(c, s, planes, e, waves, w->patterns, w->casters, ahead, phases, high, &w->layers[b]));
  }
}

/* Whether what is seen within `p` may be in the column at `u`, in rows from height `high` down to `low`. */
static inline int shows(const Extent* p, float u, float high, float low) {
  return u >= p->left && u <= p->right && high > p->bottom && low < p->top;
}

/* Draws one frame of a camera that is fixed to the body, [H, C]. */
static void draw_tilted(const Camera* c, const Shapes* s, const Eye* e, Work* w, const Wave* waves,
                        const Plane* planes, float* picture) {
  const int blocks = rounded_up(c->height) / LANES, of_shape = HEIGHTS(1, c->across) * w->stride;
  Bounds bounds;
  bounds_of(c, e, &bounds);
  int visible = 0;
  memset(w->found, 0, sizeof(int) * (size_t)c->width);
  for (int n = 0; n < s->boxes + s->cylinders; ++n) {
    Tilted* p = &w->tilted[visible];
    if (!tilted_shape(c, s, e, &bounds, n, p)) continue;
    float* heights = w->heights + (size_t)visible * of_shape;
    for (int first = p->first / LANES * LANES; first < p->last; first += LANES)
      write_heights(c, p, load(w->u + first), heights + first, w->stride);
    for (int column = p->first; column < p->last; ++column) {
      w->covering[column * w->most + w->found[column]] = visible;
      w->found[column] += heights[column] < heights[w->stride + column];
    }
    ++visible;
  }
  for (int n = 0; n < s->spheres; ++n) w->spheres[n] = extent_of_sphere(c, s, e, n);
  for (int column = 0; column < c->width; ++column) {
    float ahead[3];
    ray_ahead(e, c->u[column], ahead);
    for (int b = 0; b < blocks; ++b) w->layers[b].inserted = 0;
    insert_fields(c, &w->fields, column, blocks * LANES, s->boxes + s->cylinders + s->spheres + s->planes, w->layers);
    for (int k = 0; k < w->found[column]; ++k) {
      const int n = w->covering[column * w->most + k];
      insert_tilted(c, &w->tilted[n].seen, c->u[column], w->v, w->heights + (size_t)n * of_shape + column, w->stride,
                    w->layers);
    }
    for (int n = 0; n < s->spheres; ++n)
      for (int b = 0; b < blocks; ++b)
        if (shows(&w->spheres[n], c->u[column], w->v[b * LANES], w->v[b * LANES + LANES - 1]))
          insert_sphere(c, s, e, n, ahead, load(w->v + b * LANES), &w->layers[b]);
    finish(c, s, planes, e, waves, w, ahead, column_of(c, w, column));
  }
  write_rows(c, w, picture);
}

/* Draws one frame, [H, C]. */
static void draw(const Camera* c, const Shapes* s, const Eye* e, Work* w, float* picture) {
  Wave waves[MOST_WAVES];
  waves_of(c, e, waves);
  Plane planes[MOST_PLANES];
  planes_of(c, s, e, planes);
  light_planes(c, s, e, planes);
  for (int n = 0; n < s->boxes + s->cylinders + s->spheres + s->planes + s->fields; ++n) w->patterns[n].kind = UNKNOWN;
  if (c->shadows) {
    const Across across = across_sun(c);
    for (int n = 0; n < s->boxes + s->cylinders + s->spheres; ++n) w->casters[n] = caster_of(s, &across, n);
  }
  draw_fields(c, e, &w->fields, rounded_up(c->height));
  if (c->tilted) {
    draw_tilted(c, s, e, w, waves, planes, picture);
    return;
  }
  int visible = 0;
  for (int n = 0; n < s->boxes + s->cylinders; ++n) {
    Upright shape;
    if (!upright(c, s, e, n, &shape)) continue;
    Sides* next = &w->sides[visible];
    next->first = shape.first, next->last = shape.last;
    next->numbers = w->numbers + (size_t)visible++ * NUMBERS * w->stride;
    for (int first = shape.first / LANES * LANES; first < shape.last; first += LANES)
      sides(c, e, &shape, load(w->u + first), next->numbers + first, w->stride);
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
    const float u = c->u[column];
    float ahead[3];
    ray_ahead(e, u, ahead);
    for (int b = 0; b < blocks; ++b) w->layers[b].inserted = 0;
    insert_fields(c, &w->fields, column, blocks * LANES, s->boxes + s->cylinders + s->spheres + s->planes, w->layers);
    for (int n = 0; n < s->spheres; ++n) /* A silhouette fades over half a pixel on either side. */
      if (u + 1.5f * c->pitch > w->spheres[n].left && u - 1.5f * c->pitch < w->spheres[n].right)
        for (int b = 0; b < blocks; ++b) insert_sphere(c, s, e, n, ahead, load(w->v + b * LANES), &w->layers[b]);
    for (int n = 0; n < w->found[column]; ++n) {
      const float* numbers = w->sides[w->covering[column * w->most + n]].numbers + column;
      for (int b = 0; b < blocks; ++b) insert_side(c, numbers, w->stride, b * LANES, &w->layers[b]);
    }
    finish(c, s, planes, e, waves, w, ahead, column_of(c, w, column));
  }
  write_rows(c, w, picture);
}

/* Depth along the middle ray of every pixel of a camera that is fixed to the body, [H, C]. */
static void measure_tilted(const Camera* c, const Shapes* s, const Eye* e, Work* w, const Plane* planes,
                           float* picture) {
  Bounds bounds;
  bounds_of(c, e, &bounds);
  int visible = 0;
  memset(w->found, 0, sizeof(int) * (size_t)c->width);
  for (int n = 0; n < s->boxes + s->cylinders; ++n) {
    Tilted* p = &w->tilted[visible];
    if (!tilted_shape(c, s, e, &bounds, n, p)) continue;
    float* heights = w->heights + (size_t)(2 * visible) * w->stride;
    for (int first = p->first / LANES * LANES; first < p->last; first += LANES) {
      Lanes low, high;
      heights_of_shape(p, load(w->u + first), &low, &high);
      store(heights + first, low - c->pitch), store(heights + w->stride + first, high + c->pitch);
    }
    for (int column = p->first; column < p->last; ++column) {
      w->covering[column * w->most + w->found[column]] = visible;
      w->found[column] += heights[column] < heights[w->stride + column];
    }
    ++visible;
  }
  for (int column = 0; column < c->width; ++column) {
    float ahead[3], *nearest = column_of(c, w, column);
    ray_ahead(e, c->u[column], ahead);
    for (int row = 0; row < c->height; row += LANES) {
      const Lanes v = load(w->v + row), dx = ahead[0] + e->up[0] * v, dy = ahead[1] + e->up[1] * v;
      store(nearest + row, nearest_of_others(s, planes, e, dx, dy, ahead[2] + e->up[2] * v));
    }
    for (int k = 0; k < w->found[column]; ++k) {
      const int n = w->covering[column * w->most + k];
      const Tilted* p = &w->tilted[n];
      const float* heights = w->heights + (size_t)(2 * n) * w->stride + column;
      for (int row = 0; row < c->height; row += LANES) {
        const int last = row + LANES < c->height ? row + LANES - 1 : c->height - 1;
        if (w->v[row] < heights[0] || w->v[last] > heights[w->stride]) continue;
        store(nearest + row, nearer_tilted(s, e, p, ahead, load(w->v + row), load(nearest + row)));
      }
    }
  }
  write_rows(c, w, picture);
}

/* Depth along the middle ray of every pixel of one frame, [H, C]; NOWHERE where there is nothing. */
static void measure(const Camera* c, const Shapes* s, const Eye* e, Work* w, float* picture) {
  Plane planes[MOST_PLANES];
  planes_of(c, s, e, planes);
  if (c->tilted) {
    measure_tilted(c, s, e, w, planes, picture);
    return;
  }
  for (int n = 0; n < s->spheres; ++n) w->spheres[n] = extent_of_sphere(c, s, e, n);
  memset(w->found, 0, sizeof(int) * (size_t)c->width);
  for (int n = 0; n < s->boxes + s->cylinders; ++n) {
    if (upright_out_of_sight(c, s, e, n)) continue;
    float *from = w->numbers + (size_t)n * NUMBERS * w->stride, *to = from + w->stride;
    const Turn turn = turn_of(s, n);
    for (int first = 0; first < c->width; first += LANES) {
      const Lanes u = load(w->u + first), dx = e->cos + u * e->sin, dy = e->sin - u * e->cos;
      Lanes begin, end;
      beside(s, e, n, turn, dx, dy, &begin, &end);
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
      Lanes nearest = nearest_of_planes(s, planes, lanes(dx), lanes(dy), dz);
      for (int n = 0; n < s->spheres; ++n)
        if (shows(&w->spheres[n], c->u[column], w->v[first], w->v[first + LANES - 1]))
          nearest = nearer_sphere(s, e, n, lanes(dx), lanes(dy), dz, nearest);
      for (int k = 0; k < w->found[column]; ++k) {
        const int n = w->covering[column * w->most + k];
        const float* from = w->numbers + (size_t)n * NUMBERS * w->stride + column;
        nearest = nearer_upright(level_of(s, e, n), lanes(from[0]), lanes(from[w->stride]), per_z, nearest);
      }
      store(column_of(c, w, column) + first, nearest);
    }
  }
  write_rows(c, w, picture);
}

/* ------------------------------------------------------------------------------------------------------- handlers */

typedef void Render(const Camera*, const Shapes*, const Eye*, Work*, float*);

static void measure_all(const Camera* c, const Shapes* s, const Eye* e, Work* w, float* picture) {
  measure(c, s, e, w, picture);
  measure_fields(c, e, &w->fields, picture);
}

static XLA_FFI_Error* each_frame(XLA_FFI_CallFrame* call, Render* render, int weighted) {
  if (asked_for_version(call)) return 0;
  Batch batch;
  FieldBatch fields;
  const int first = operands_of(weighted), more = call->args.size == first + FIELD_OPERANDS ? FIELD_OPERANDS : 0;
  XLA_FFI_Error* error = batch_of(call, weighted, more, &batch);
  if (error || !batch.frames) return error;
  Camera camera;
  Shapes shapes;
  Eye eye;
  const float* of[OPERANDS];
  memcpy(of, batch.data, sizeof of);
  frame_of(&batch, of, &camera, &shapes, &eye);
  fields_of(call, first, more, batch.frames, &fields);
  shapes.fields = fields.count;
  Work work = {0};
  if (!prepare(&camera, &shapes, &work)) {
    release(&work);
    return failed(call, XLA_FFI_Error_Code_RESOURCE_EXHAUSTED,
                  "pictures.c found no memory for the columns of a frame; the image must be smaller");
  }
  for (uint32_t m = 0; m < batch.frames; ++m) {
    for (int i = ORIGIN; i < OPERANDS; ++i) of[i] = of_frame(&batch, i, m);
    frame_of(&batch, of, &camera, &shapes, &eye);
    fields_of_frame(&fields, m, &work.fields, &shapes);
    const int64_t pixels = (int64_t)batch.height * batch.width;
    float* picture = batch.pictures + m * pixels;
    if (eye.is_finite || !weighted)
      render(&camera, &shapes, &eye, &work, picture);
    else
      for (int64_t i = 0; i < pixels; ++i) picture[i] = not_a_number();
  }
  release(&work);
  return 0;
}

XLA_FFI_Error* edqn_pictures(XLA_FFI_CallFrame* call) { return each_frame(call, draw, 1); }

XLA_FFI_Error* edqn_depths(XLA_FFI_CallFrame* call) { return each_frame(call, measure_all, 0); }

XLA_FFI_Error* edqn_tilted_pictures(XLA_FFI_CallFrame* call) { return edqn_pictures(call); }

XLA_FFI_Error* edqn_tilted_depths(XLA_FFI_CallFrame* call) { return edqn_depths(call); }
