/* All rays and fields of a call of XLA's, for `field_rays.c` and `field_rays.cu`; how they meet is in `field_rays.h`. */

#ifndef EDQN_FIELD_BATCH_H
#define EDQN_FIELD_BATCH_H

#include "xla/ffi/api/c_api.h"
#include "handler.h"
#include "field_rays.h"

/* [.., N, 3] position, [.., N, 3, 3] rotation, [.., N, 3] half, [.., N] grid, [.., 3] origin, [.., 3, P] rays →
 * [.., N, P] depths, FAR_M where nothing is met, and [.., N, 3, P] normals. */
enum { VALUES, FIRST, LEAST, FIRST_LEAST, COUNTS, CELL, POSITION, ROTATION, HALF, GRID, ORIGIN, RAYS, OPERANDS };
enum { DEPTH, NORMAL, RESULTS };

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
  const int16_t* values;
  const float *least, *cells;
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
  batch->values = (const int16_t*)data[VALUES], batch->least = (const float*)data[LEAST];
  batch->cells = (const float*)data[CELL], batch->counts = (const int32_t*)data[COUNTS];
  batch->starts = (const int32_t*)data[FIRST], batch->blocks = (const int32_t*)data[FIRST_LEAST];
  batch->depth = (float*)depth->data;
  batch->normal = (float*)((const XLA_FFI_Buffer*)call->rets.rets[NORMAL])->data;
  return 0;
}

/* Draws rays `begin` to `end` of field n in row m. */
FN void draw_some(const Batch* b, uint32_t m, int64_t n, int64_t begin, int64_t end) {
  const float* of[OPERANDS];
  const int64_t at = ((int64_t)m * b->fields + n) * b->count;
  for (int k = POSITION; k < OPERANDS; ++k) of[k] = b->of[k].data;
  for (int i = (int)b->leading - 1; i >= 0; --i) {
    const uint32_t here = m % (uint32_t)b->axes[i];
    m /= (uint32_t)b->axes[i];
    for (int k = POSITION; k < OPERANDS; ++k) of[k] += here * b->of[k].apart[i];
  }
  const int grid = (int)of[GRID][n];
  const Lattice g = lattice_of(b->values + b->starts[grid], b->least + b->blocks[grid], b->counts + 3 * grid,
                               b->cells[grid]);
  const View v = view_of(&g, of[POSITION] + 3 * n, of[ROTATION] + 9 * n, of[HALF] + 3 * n, of[ORIGIN]);
  const float* const rays[3] = {of[RAYS] + begin, of[RAYS] + b->count + begin, of[RAYS] + 2 * b->count + begin};
  float* first = b->normal + 3 * at + begin;
  float* const normal[3] = {first, first + b->count, first + 2 * b->count};
  trace(&g, &v, rays, end - begin, b->depth + at + begin, normal);
}

#endif
