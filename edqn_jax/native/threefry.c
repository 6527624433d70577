/* Threefry-2x32 in 20 rounds (Salmon et al. 2011), for CPUs: a handler of XLA's foreign function interface
 * (`threefry.py` registers it).
 *
 * Operands are both words of the keys and both of the counts, results both words of the bits: arrays of uint32 of one
 * shape.
 */

#include <stdint.h>

#include "handler.h"

#define PARITY 0x1BD11BDAu

static inline uint32_t rotated(uint32_t x, int bits) { return (x << bits) | (x >> (32 - bits)); }

#define ROUND(bits) x += y, y = rotated(y, bits) ^ x
#define FOUR(a, b, c, d) ROUND(a), ROUND(b), ROUND(c), ROUND(d)

static void draw(int64_t count, const uint32_t* restrict key0, const uint32_t* restrict key1,
                 const uint32_t* restrict count0, const uint32_t* restrict count1, uint32_t* restrict bits0,
                 uint32_t* restrict bits1) {
  for (int64_t i = 0; i < count; ++i) {
    const uint32_t a = key0[i], b = key1[i], c = a ^ b ^ PARITY;
    uint32_t x = count0[i] + a, y = count1[i] + b;
    FOUR(13, 15, 26, 6), x += b, y += c + 1;
    FOUR(17, 29, 16, 24), x += c, y += a + 2;
    FOUR(13, 15, 26, 6), x += a, y += b + 3;
    FOUR(17, 29, 16, 24), x += b, y += c + 4;
    FOUR(13, 15, 26, 6), x += c, y += a + 5;
    bits0[i] = x, bits1[i] = y;
  }
}

XLA_FFI_Error* edqn_threefry(XLA_FFI_CallFrame* call) {
  if (asked_for_version(call)) return 0;
  const XLA_FFI_Buffer* first = (const XLA_FFI_Buffer*)call->args.args[0];
  int64_t count = 1;
  for (int i = 0; i < first->rank; ++i) count *= first->dims[i];
  uint32_t* data[6];
  for (int i = 0; i < 6; ++i)
    data[i] = (uint32_t*)((XLA_FFI_Buffer*)(i < 4 ? call->args.args[i] : call->rets.rets[i - 4]))->data;
  draw(count, data[0], data[1], data[2], data[3], data[4], data[5]);
  return 0;
}
