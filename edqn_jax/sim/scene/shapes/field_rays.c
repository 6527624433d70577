/* Where rays meet fields, as a handler of XLA's foreign function interface (`field_rays.py` compiles and registers it).
 * How is in `field_rays.h`.
 */

#define FN static inline

#include "field_batch.h"

XLA_FFI_Error* edqn_field_rays(XLA_FFI_CallFrame* call) {
  if (asked_for_version(call)) return 0;
  Batch batch;
  XLA_FFI_Error* error = batch_of(call, &batch);
  if (error) return error;
  for (uint32_t m = 0; m < batch.rows; ++m)
    for (int64_t n = 0; n < batch.fields; ++n) draw_some(&batch, m, n, 0, batch.count);
  return 0;
}
