/* Where rays meet fields, in C for CPUs and in CUDA: `field_rays.c` and `field_rays.cu` include this, `field.py` has
 * the same in JAX.
 *
 * A ray advances by the distance at its end until that is small or the ray has left the box around the solid,
 * neighbours together as far as none of them can meet anything. Whoever includes it says what a function is (FN) and
 * how many rays go TOGETHER.
 */

#ifndef EDQN_FIELD_RAYS_H
#define EDQN_FIELD_RAYS_H

#include <math.h>
#include <stdint.h>

#include "xla/ffi/api/c_api.h"
#include "handler.h"

#define TINY 1e-9f /* kind.py; the others are of field_rays.py: tests/sim/scene/test_field_rays.py holds them equal */
#define STEPS 64
#define STOPS 0.03f
#define CONE 0.0005f
#define BLOCK 4
#define WORTH 0.2f
#define FAR 1e30f

/* [.., N, 3] position, [.., N, 3, 3] rotation, [.., N, 3] half, [.., N] grid, [.., 3] origin, [.., P, 3] rays →
 * [.., N, P] depths, FAR where nothing is met, and [.., N, P, 3] normals. */
enum { VALUES, FIRST, LEAST, FIRST_LEAST, COUNTS, CELL, POSITION, ROTATION, HALF, GRID, ORIGIN, RAYS, OPERANDS };
enum { DEPTH, NORMAL, RESULTS };

typedef struct {
  const float *values, *least; /* least: in each block of BLOCK cells along each axis */
  int across, along;           /* values from one place to the next along x and y */
  int blocks_across, blocks_along;
  int last[3];
  float per_cell, cell;
} Lattice;

/* Rays from one place in a field's own axes, side by side: what is done to all of them becomes vectors. */
typedef struct {
  float o[3], d[3][TOGETHER], per_length[TOGETHER], enter[TOGETHER], leave[TOGETHER], depth[TOGETHER];
} Rays;

FN float limited(float x, float most) {
  x = x > 0.0f ? x : 0.0f;
  return x < most ? x : most;
}

FN float inverse(float x) { return 1.0f / (fabsf(x) < TINY ? TINY : x); }

/* Where the rays are: the number of a value, or of a block, and the share of a cell. */
FN void cells_of(const Lattice* g, const Rays* r, int32_t* first, float part[3][TOGETHER]) {
  for (int l = 0; l < TOGETHER; ++l) first[l] = 0;
  for (int i = 0; i < 3; ++i) {
    const int32_t stride = i == 0 ? g->across : i == 1 ? g->along : 1;
    const float last = (float)g->last[i];
    for (int l = 0; l < TOGETHER; ++l) {
      const float at = limited((r->o[i] + r->depth[l] * r->d[i][l]) * g->per_cell + 0.5f * last, last);
      int32_t lower = (int32_t)at;
      lower = lower < g->last[i] - 1 ? lower : g->last[i] - 1;
      part[i][l] = at - (float)lower;
      first[l] += lower * stride;
    }
  }
}

FN void blocks_of(const Lattice* g, const Rays* r, int32_t* block) {
  for (int l = 0; l < TOGETHER; ++l) block[l] = 0;
  for (int i = 0; i < 3; ++i) {
    const int32_t stride = i == 0 ? g->blocks_across : i == 1 ? g->blocks_along : 1;
    const float last = (float)g->last[i];
    for (int l = 0; l < TOGETHER; ++l) {
      const float at = limited((r->o[i] + r->depth[l] * r->d[i][l]) * g->per_cell + 0.5f * last, last);
      const int32_t lower = (int32_t)at;
      block[l] += (int32_t)((uint32_t)(lower < g->last[i] - 1 ? lower : g->last[i] - 1) / BLOCK) * stride;
    }
  }
}

/* The distances between the values of the lattice, and their slopes per cell where they are asked for. */
FN void interpolate(const Lattice* g, const Rays* r, float* found, float slope[3][TOGETHER]) {
  int32_t first[TOGETHER];
  float part[3][TOGETHER], corner[8][TOGETHER];
  cells_of(g, r, first, part);
  for (int l = 0; l < TOGETHER; ++l) {
    const float *v = g->values + first[l], *w = v + g->along, *x = v + g->across, *y = x + g->along;
    corner[0][l] = v[0], corner[1][l] = v[1], corner[2][l] = w[0], corner[3][l] = w[1];
    corner[4][l] = x[0], corner[5][l] = x[1], corner[6][l] = y[0], corner[7][l] = y[1];
  }
  for (int l = 0; l < TOGETHER; ++l) {
    const float dz00 = corner[1][l] - corner[0][l], dz01 = corner[3][l] - corner[2][l];
    const float dz10 = corner[5][l] - corner[4][l], dz11 = corner[7][l] - corner[6][l];
    const float z00 = corner[0][l] + part[2][l] * dz00, z01 = corner[2][l] + part[2][l] * dz01;
    const float z10 = corner[4][l] + part[2][l] * dz10, z11 = corner[6][l] + part[2][l] * dz11;
    const float y0 = z00 + part[1][l] * (z01 - z00), y1 = z10 + part[1][l] * (z11 - z10);
    found[l] = y0 + part[0][l] * (y1 - y0);
    if (slope) {
      const float s0 = dz00 + part[1][l] * (dz01 - dz00), s1 = dz10 + part[1][l] * (dz11 - dz10);
      slope[0][l] = y1 - y0;
      slope[1][l] = (z01 - z00) + part[0][l] * ((z11 - z10) - (z01 - z00));
      slope[2][l] = s0 + part[0][l] * (s1 - s0);
    }
  }
}

FN float length(float x, float y, float z) { return sqrtf(x * x + y * y + z * z); }

/* The depth up to which nothing is met by rays about their middle, by the least distances of blocks. */
FN float march_together(const Lattice* g, const Rays* r, float first, float last) {
  float d[3] = {0.0f, 0.0f, 0.0f}, spread = 0.0f, depth = first;
  for (int i = 0; i < 3; ++i)
    for (int l = 0; l < TOGETHER; ++l) d[i] += r->d[i][l] * (1.0f / TOGETHER);
  for (int l = 0; l < TOGETHER; ++l) {
    const float wide = length(r->d[0][l] - d[0], r->d[1][l] - d[1], r->d[2][l] - d[2]);
    spread = wide > spread ? wide : spread;
  }
  const float per_length = 1.0f / (length(d[0], d[1], d[2]) + spread);
  for (int step = 0; step < STEPS && depth < last; ++step) {
    int32_t at[3];
    for (int i = 0; i < 3; ++i) {
      const float last_value = (float)g->last[i];
      const int32_t lower = (int32_t)limited((r->o[i] + depth * d[i]) * g->per_cell + 0.5f * last_value, last_value);
      at[i] = (int32_t)((uint32_t)(lower < g->last[i] - 1 ? lower : g->last[i] - 1) / BLOCK);
    }
    const float room = g->least[at[0] * g->blocks_across + at[1] * g->blocks_along + at[2]] - spread * depth;
    if (room < WORTH * spread * depth + g->cell) break;
    depth += room * per_length;
  }
  return depth;
}

/* Advances each of the rays to the surface, by the least distances of blocks, and then by those in between. */
FN void march(const Lattice* g, Rays* r) {
  float left[TOGETHER];
  int32_t block[TOGETHER], going = 1;
  for (int step = 0; step < STEPS && going; ++step) {
    blocks_of(g, r, block);
    for (int l = 0; l < TOGETHER; ++l) left[l] = g->least[block[l]];
    going = 0;
    for (int l = 0; l < TOGETHER; ++l) {
      const int32_t on = (left[l] >= g->cell) & (r->depth[l] < r->leave[l]) & (r->enter[l] < r->leave[l]);
      r->depth[l] += on ? left[l] * r->per_length[l] : 0.0f;
      going |= on;
    }
  }
  going = 1;
  for (int step = 0; step < STEPS && going; ++step) {
    interpolate(g, r, left, 0);
    going = 0;
    for (int l = 0; l < TOGETHER; ++l) {
      const int32_t on = (left[l] >= STOPS * g->cell + CONE * r->depth[l]) & (r->depth[l] < r->leave[l]) &
                         (r->enter[l] < r->leave[l]);
      r->depth[l] += on ? left[l] * r->per_length[l] : 0.0f;
      going |= on;
    }
  }
}

/* Rays [count, 3] from `origin` and one field, turned by `t`: depths [count] and normals [count, 3]. */
FN void draw(const Lattice* g, const float* position, const float* t, const float* half, const float* origin,
             const float* rays, int64_t count, float* depths, float* normals) {
  float away[3];
  Rays r;
  for (int i = 0; i < 3; ++i) away[i] = origin[i] - position[i];
  for (int i = 0; i < 3; ++i) r.o[i] = t[i] * away[0] + t[3 + i] * away[1] + t[6 + i] * away[2];
  for (int64_t begin = 0; begin < count; begin += TOGETHER) {
    float ray[3][TOGETHER], left[TOGETHER], slope[3][TOGETHER], first = FAR, last = 0.0f;
    for (int l = 0; l < TOGETHER; ++l) {
      const float* one = rays + 3 * (begin + l < count ? begin + l : count - 1);
      ray[0][l] = one[0], ray[1][l] = one[1], ray[2][l] = one[2], r.enter[l] = 0.0f, r.leave[l] = FAR;
    }
    for (int i = 0; i < 3; ++i) {
      for (int l = 0; l < TOGETHER; ++l) {
        r.d[i][l] = t[i] * ray[0][l] + t[3 + i] * ray[1][l] + t[6 + i] * ray[2][l];
        const float per = inverse(r.d[i][l]), centre = -r.o[i] * per, reach = half[i] * fabsf(per);
        r.enter[l] = centre - reach > r.enter[l] ? centre - reach : r.enter[l];
        r.leave[l] = centre + reach < r.leave[l] ? centre + reach : r.leave[l];
      }
    }
    for (int l = 0; l < TOGETHER; ++l) {
      r.per_length[l] = 1.0f / length(r.d[0][l], r.d[1][l], r.d[2][l]);
      first = r.enter[l] < first ? r.enter[l] : first, last = r.leave[l] > last ? r.leave[l] : last;
    }
    const float free = first < last ? march_together(g, &r, first, last) : first;
    for (int l = 0; l < TOGETHER; ++l) r.depth[l] = free > r.enter[l] ? free : r.enter[l];
    if (first < last) march(g, &r);
    interpolate(g, &r, left, slope);
    for (int l = 0; l < TOGETHER && begin + l < count; ++l) {
      float* normal = normals + 3 * (begin + l);
      const int hit = (r.depth[l] > 0.0f) & (r.depth[l] < r.leave[l]);
      const float scale = hit ? inverse(length(slope[0][l], slope[1][l], slope[2][l])) : 0.0f;
      depths[begin + l] = hit ? r.depth[l] : FAR;
      for (int j = 0; j < 3; ++j)
        normal[j] = scale * (t[3 * j] * slope[0][l] + t[3 * j + 1] * slope[1][l] + t[3 * j + 2] * slope[2][l]);
    }
  }
}

#define MOST_AXES 8 /* that are mapped */

/* An operand, and how far apart its rows are along each leading axis of the results: 0 where there is one for all. */
typedef struct {
  const float* data;
  int64_t apart[MOST_AXES];
} Operand;

/* All fields that one call draws: `rows` times `fields`, `count` rays each. */
typedef struct {
  Operand of[OPERANDS];
  int64_t axes[MOST_AXES], leading, rows, fields, count;
  const float *values, *least, *cells;
  const int32_t *counts, *starts, *blocks;
  float *depth, *normal;
} Batch;

/* Reads what a call is of. */
static inline XLA_FFI_Error* batch_of(XLA_FFI_CallFrame* call, Batch* batch) {
  if (call->args.size != OPERANDS || call->rets.size != RESULTS)
    return failed(call, XLA_FFI_Error_Code_INVALID_ARGUMENT, "the operands of fields are not those of field_rays.py");
  const XLA_FFI_Buffer* depth = (const XLA_FFI_Buffer*)call->rets.rets[DEPTH];
  const int64_t leading = depth->rank - 2;
  if (leading > MOST_AXES)
    return failed(call, XLA_FFI_Error_Code_INVALID_ARGUMENT, "rays through fields are mapped too often");
  const void* data[OPERANDS];
  batch->leading = leading, batch->fields = depth->dims[leading], batch->count = depth->dims[leading + 1];
  batch->rows = 1;
  for (int64_t i = 0; i < leading; ++i) batch->rows *= batch->axes[i] = depth->dims[i];
  for (int k = 0; k < OPERANDS; ++k) {
    const XLA_FFI_Buffer* b = (const XLA_FFI_Buffer*)call->args.args[k];
    data[k] = b->data;
    if (k < POSITION) continue;
    int64_t size = 1;
    for (int64_t i = leading; i < b->rank; ++i) size *= b->dims[i];
    for (int64_t i = leading - 1; i >= 0; --i) {
      batch->of[k].apart[i] = b->dims[i] == 1 ? 0 : size;
      size *= b->dims[i];
    }
    batch->of[k].data = (const float*)b->data;
  }
  batch->values = (const float*)data[VALUES], batch->least = (const float*)data[LEAST];
  batch->cells = (const float*)data[CELL], batch->counts = (const int32_t*)data[COUNTS];
  batch->starts = (const int32_t*)data[FIRST], batch->blocks = (const int32_t*)data[FIRST_LEAST];
  batch->depth = (float*)depth->data;
  batch->normal = (float*)((const XLA_FFI_Buffer*)call->rets.rets[NORMAL])->data;
  return 0;
}

/* Draws rays `begin` to `end` of field n in row m. */
FN void draw_some(const Batch* b, uint32_t m, int64_t n, int64_t begin, int64_t end) {
  const float* of[OPERANDS];
  const int64_t at = ((int64_t)m * b->fields + n) * b->count + begin;
  for (int k = POSITION; k < OPERANDS; ++k) of[k] = b->of[k].data;
  for (int i = (int)b->leading - 1; i >= 0; --i) {
    const uint32_t here = m % (uint32_t)b->axes[i];
    m /= (uint32_t)b->axes[i];
    for (int k = POSITION; k < OPERANDS; ++k) of[k] += here * b->of[k].apart[i];
  }
  const int grid = (int)of[GRID][n];
  const int32_t* c = b->counts + 3 * grid;
  const float cell = b->cells[grid];
  const int y = (c[1] + BLOCK - 2) / BLOCK, z = (c[2] + BLOCK - 2) / BLOCK;
  const Lattice g = {b->values + b->starts[grid], b->least + b->blocks[grid], c[1] * c[2], c[2], y * z, z,
                     {c[0] - 1, c[1] - 1, c[2] - 1}, 1.0f / cell, cell};
  draw(&g, of[POSITION] + 3 * n, of[ROTATION] + 9 * n, of[HALF] + 3 * n, of[ORIGIN], of[RAYS] + 3 * begin, end - begin,
       b->depth + at, b->normal + 3 * at);
}

#endif
