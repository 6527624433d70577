/* Fields in pictures and depth images for CPUs, under any camera: coverage is counted over a few rays a pixel, as
 * `coverage.add_sampled_layers` does; `pictures.c` includes this. Where rays meet a field is in `field_rays.h`. GPUs
 * have fields drawn by JAX.
 *
 * All rays of a frame are traced at once, a pixel's side by side, column by column.
 */

#ifndef EDQN_FIELDS_H
#define EDQN_FIELDS_H

#include "../scene/shapes/field_rays.h"

#define LEVEL 0.7f       /* coverage.py */
#define OF_LEVEL 1024.0f /* more than a pixel has rays: what is added for each that meets a level face */

/* Operands after those of pictures: a table of grids, and from FIELD_POSITION on what has a leading [L]. */
enum {
  VALUES,
  FIRST_VALUE,
  LEAST,
  FIRST_LEAST,
  COUNTS,
  CELL,
  FIELD_POSITION,
  FIELD_ROTATION,
  FIELD_HALF,
  FIELD_GRID,
  FIELD_ALBEDO,
  FIELD_SURFACE,
  FIELD_OPERANDS
};

/* The fields of one call. */
typedef struct {
  const void* data[FIELD_OPERANDS];
  int64_t size[FIELD_OPERANDS]; /* of a row */
  uint32_t serves[FIELD_OPERANDS];
  int count;
} FieldBatch;

/* The fields of a frame, and memory for what is seen of them. */
typedef struct {
  int count;
  const float *position, *rotation, *half, *grid, *albedo;
  const FieldBatch* batch;
  float *ray[3], *depth, *normal[3];
  float* layer[4]; /* closeness, coverage, value, slope: rows of a column, columns, fields */
  int* seen;       /* whether a field may be seen, by field: otherwise its layers hold nothing */
} Fields;

/* Reads `more` operands of a call, those of fields or none, from `first` on. */
static void fields_of(const XLA_FFI_CallFrame* call, int first, int more, uint32_t frames, FieldBatch* b) {
  memset(b, 0, sizeof *b);
  if (!more) return;
  XLA_FFI_Buffer** arg = (XLA_FFI_Buffer**)call->args.args + first;
  for (int i = 0; i < FIELD_OPERANDS; ++i) {
    b->data[i] = arg[i]->data;
    if (i < FIELD_POSITION) continue;
    b->size[i] = 1, b->serves[i] = frames / (uint32_t)arg[i]->dims[0];
    for (int d = 1; d < arg[i]->rank; ++d) b->size[i] *= arg[i]->dims[d];
  }
  b->count = (int)arg[FIELD_POSITION]->dims[1];
}

static const float* of_field(const FieldBatch* b, int operand, uint32_t m) {
  return (const float*)b->data[operand] + m / b->serves[operand] * b->size[operand];
}

static void fields_of_frame(const FieldBatch* b, uint32_t m, Fields* f, Shapes* s) {
  f->count = b->count, f->batch = b;
  if (!b->count) return;
  f->position = of_field(b, FIELD_POSITION, m), f->rotation = of_field(b, FIELD_ROTATION, m);
  f->half = of_field(b, FIELD_HALF, m), f->grid = of_field(b, FIELD_GRID, m);
  f->albedo = of_field(b, FIELD_ALBEDO, m);
  s->fields = b->count, s->field_position = f->position, s->field_surface = of_field(b, FIELD_SURFACE, m);
}

/* Takes memory for `count` fields of a frame, whose columns are `rows` apart; returns whether there is enough. */
static int prepare_fields(const Camera* c, int rows, int count, Fields* f) {
  memset(f, 0, sizeof *f);
  if (!count) return 1;
  const size_t drawn = (size_t)c->width * c->height * (c->across * c->down);
  const size_t rays = (drawn + WIDE - 1) / WIDE * WIDE, pixels = (size_t)c->width * rows * count;
  float* memory = malloc(sizeof(float) * (7 * rays + 4 * pixels) + sizeof(int) * (size_t)count);
  f->ray[0] = memory;
  if (!memory) return 0;
  f->ray[1] = memory + rays, f->ray[2] = memory + 2 * rays, f->depth = memory + 3 * rays;
  for (int i = 0; i < 3; ++i) f->normal[i] = memory + (4 + i) * rays;
  for (int i = 0; i < 4; ++i) f->layer[i] = memory + 7 * rays + i * pixels;
  memset(f->layer[0], 0, sizeof(float) * 4 * pixels); /* also rows beyond the image, which nothing writes */
  f->seen = (int*)(memory + 7 * rays + 4 * pixels);
  return 1;
}

/* Sets the rays of a frame: `across` x `down` of each pixel. */
static void rays_of_frame(const Camera* c, const Eye* e, int across, int down, const Fields* f) {
  int64_t n = 0;
  for (int column = 0; column < c->width; ++column)
    for (int row = 0; row < c->height; ++row)
      for (int d = 0; d < down; ++d) {
        const float v = c->v[row] + c->pitch * ((d + 0.5f) / down - 0.5f);
        for (int a = 0; a < across; ++a, ++n) {
          const float u = c->u[column] + c->pitch * ((a + 0.5f) / across - 0.5f);
          for (int i = 0; i < 3; ++i) f->ray[i][n] = e->forward[i] + u * e->right[i] + v * e->up[i];
        }
      }
}

/* Traces the rays of a frame to field `n`; returns whether any comes near it. */
static int trace_field(const Eye* e, const Fields* f, int n, int64_t rays) {
  const FieldBatch* b = f->batch;
  const int grid = (int)f->grid[n];
  const Lattice g = lattice_of((const int16_t*)b->data[VALUES] + ((const int32_t*)b->data[FIRST_VALUE])[grid],
                               (const float*)b->data[LEAST] + ((const int32_t*)b->data[FIRST_LEAST])[grid],
                               (const int32_t*)b->data[COUNTS] + 3 * grid, ((const float*)b->data[CELL])[grid]);
  const View v = view_of(&g, f->position + 3 * n, f->rotation + 9 * n, f->half + 3 * n, e->origin);
  return trace(&g, &v, (const float* const*)f->ray, rays, f->depth, f->normal);
}

/* Turns depths and normals of rays into what pixels add up: closeness, brightness, slope, and which were met. */
static void shade_rays(const Camera* c, const Eye* e, const Fields* f, int64_t rays) {
  const float *sun = c->sun, *right = e->right;
  for (int64_t b = 0; b < rays; b += WIDE) { /* what is beyond the last is never read */
    const Wide depth = wide_at(f->depth + b);
    const Wide x = wide_at(f->normal[0] + b), y = wide_at(f->normal[1] + b), z = wide_at(f->normal[2] + b);
    const Whole hit = depth < 1e29f;
    const Wide closeness = choose(hit, one_over(depth), wide(0));
    const Wide lit = larger(x * sun[0] + y * sun[1] + z * sun[2], wide(0));
    const Wide lean = (x * right[0] + y * right[1] + z * right[2]) * c->pitch;
    const Wide ahead = x * wide_at(f->ray[0] + b) + y * wide_at(f->ray[1] + b) + z * wide_at(f->ray[2] + b);
    keep(f->depth + b, closeness);
    keep(f->normal[0] + b, choose(hit, c->ambient + (1 - c->ambient) * lit, wide(0)));
    keep(f->normal[1] + b, choose(hit, lean * closeness * one_over(ahead), wide(0)));
    keep(f->normal[2] + b, choose(hit, choose(size_of(z) > LEVEL, wide(1 + OF_LEVEL), wide(1)), wide(0)));
  }
}

/* Adds up the rays of each pixel to the layers of field `n`; columns are `rows` apart. */
static void layers_of_field(const Camera* c, const Eye* e, const Fields* f, int n, int rows) {
  const int samples = c->across * c->down;
  const float value = dot3(f->albedo + 3 * n, e->weights), per_ray = 1.0f / samples;
  const float *closeness = f->depth, *bright = f->normal[0], *slope = f->normal[1], *met = f->normal[2];
  for (int column = 0; column < c->width; ++column)
    for (int row = 0; row < c->height; ++row) {
      float near = 0, lit = 0, lean = 0, marks = 0;
      for (int k = 0; k < samples; ++k) near += *closeness++, lit += *bright++, lean += *slope++, marks += *met++;
      const float level = floorf(marks * (1 / OF_LEVEL)), count = marks - OF_LEVEL * level, per = 1 / most(count, 1);
      const size_t at = ((size_t)n * c->width + column) * rows + row;
      f->layer[0][at] = near * per, f->layer[1][at] = count * per_ray, f->layer[2][at] = value * lit * per_ray;
      f->layer[3][at] = c->tilted ? 0 : 2 * level > count ? LEVEL_FACE : lean * per;
    }
}

/* Draws all fields of a frame into their layers. */
static void draw_fields(const Camera* c, const Eye* e, const Fields* f, int rows) {
  const int64_t rays = (int64_t)c->width * c->height * c->across * c->down;
  if (f->count) rays_of_frame(c, e, c->across, c->down, f);
  for (int n = 0; n < f->count; ++n) {
    f->seen[n] = trace_field(e, f, n, rays);
    if (!f->seen[n]) continue;
    shade_rays(c, e, f, rays);
    layers_of_field(c, e, f, n, rows);
  }
}

/* Adds the fields to the layers of the rows of a column, in blocks of LANES; `first`: number of the first of them. */
static void insert_fields(const Camera* c, const Fields* f, int column, int rows, int first, Layers* layers) {
  for (int n = 0; n < f->count; ++n)
    for (int row = 0; f->seen[n] && row < rows; row += LANES) {
      const size_t at = ((size_t)n * c->width + column) * rows + row;
      const Lanes coverage = load(f->layer[1] + at);
      if (!any_of(coverage > 0)) continue;
      const Layer added = {load(f->layer[0] + at), coverage, load(f->layer[2] + at), load(f->layer[3] + at),
                           lanes((float)(first + n))};
      insert(&layers[row / LANES], added);
    }
}

/* Lowers the depths [H, C] of a frame to those of fields. */
static void measure_fields(const Camera* c, const Eye* e, const Fields* f, float* picture) {
  if (f->count) rays_of_frame(c, e, 1, 1, f);
  for (int n = 0; n < f->count; ++n) {
    if (!trace_field(e, f, n, (int64_t)c->width * c->height)) continue;
    for (int column = 0; column < c->width; ++column)
      for (int row = 0; row < c->height; ++row) {
        float* nearest = picture + row * c->width + column;
        *nearest = least(*nearest, f->depth[column * c->height + row]);
      }
  }
}

#endif
