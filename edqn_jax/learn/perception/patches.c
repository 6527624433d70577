/* Patches of signed images, for CPUs: a handler of XLA's foreign function interface (`patches.py` registers it).
 *
 * XLA moves one number at a time where it cuts an image, and computes the image anew for each channel that it fills.
 * Here a patch of what is above 0 and the same one of what is below stand side by side.
 */

#include <stdint.h>

#include "handler.h"

static inline void cut(const float* restrict image, int64_t images, int64_t rows, int64_t columns, int64_t side,
                       float* restrict patches) {
  const int64_t width = columns * side, area = side * side;
  for (int64_t line = 0; line < images * rows; ++line)
    for (int64_t down = 0; down < side; ++down) {
      const float* from = image + (line * side + down) * width;
      for (int64_t column = 0; column < columns; ++column, from += side) {
        float* patch = patches + (line * columns + column) * 2 * area + down * side;
        for (int64_t across = 0; across < side; ++across) {
          const float value = from[across];
          patch[across] = value > 0.0f ? value : 0.0f;
          patch[area + across] = value < 0.0f ? -value : 0.0f;
        }
      }
    }
}

XLA_FFI_Error* edqn_signed_patches(XLA_FFI_CallFrame* call) {
  if (asked_for_version(call)) return 0;
  const XLA_FFI_Buffer* image = (const XLA_FFI_Buffer*)call->args.args[0];
  const int64_t side = *(const int32_t*)((const XLA_FFI_Buffer*)call->args.args[1])->data;
  const int64_t height = image->dims[image->rank - 2], width = image->dims[image->rank - 1];
  int64_t images = 1;
  for (int i = 0; i < image->rank - 2; ++i) images *= image->dims[i];
  float* patches = (float*)((XLA_FFI_Buffer*)call->rets.rets[0])->data;
  if (side == 4) /* the usual one, of which the compiler knows the number */
    cut((const float*)image->data, images, height / 4, width / 4, 4, patches);
  else
    cut((const float*)image->data, images, height / side, width / side, side, patches);
  return 0;
}
