/* A step of Adam (Kingma & Ba 2015) on one vector of parameters, for CPUs: a handler of XLA's foreign function
 * interface (`adam.py` registers it).
 *
 * XLA passes over the numbers a dozen times, here it is twice: once for the gradient's norm, and once for the rest, in
 * blocks that stay in the innermost cache. Results are in the place of their operands.
 */

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "handler.h"

#define BLOCK 512
#define LANES 32

/* Of the first operand, in the order of `adam.py`; after them the rate of each follower. */
enum { SCALE, MOST_NORM, STEP, FIRST_DECAY, SECOND_DECAY, SECOND_CORRECTION, TINY, FOLLOWER_RATES };

enum { GRADIENT = 1, PARAMETERS, FIRST_MOMENT, SECOND_MOMENT, FOLLOWERS };

static float* operand(const XLA_FFI_CallFrame* call, int i) { return ((XLA_FFI_Buffer*)call->args.args[i])->data; }
static float* result(const XLA_FFI_CallFrame* call, int i) { return ((XLA_FFI_Buffer*)call->rets.rets[i])->data; }

/* Returns whether all numbers are finite, and gives the sum of their squares. */
static int measure(const float* restrict x, int64_t count, float* restrict squares) {
  float sums[LANES] = {0};
  int32_t largest[LANES] = {0}; /* exponents and fractions: as numbers, compilers take all for finite */
  int64_t k = 0;
  for (; k + LANES <= count; k += LANES)
    for (int lane = 0; lane < LANES; ++lane) {
      const float value = x[k + lane];
      int32_t bits;
      memcpy(&bits, &value, sizeof bits);
      bits &= 0x7fffffff;
      largest[lane] = bits > largest[lane] ? bits : largest[lane];
      sums[lane] += value * value;
    }
  for (int lane = 0; k < count; ++k, ++lane) {
    const float value = x[k];
    int32_t bits;
    memcpy(&bits, &value, sizeof bits);
    bits &= 0x7fffffff;
    largest[lane] = bits > largest[lane] ? bits : largest[lane];
    sums[lane] += value * value;
  }
  int32_t most = 0;
  float total = 0.0f;
  for (int lane = 0; lane < LANES; ++lane) {
    most = largest[lane] > most ? largest[lane] : most;
    total += sums[lane];
  }
  *squares = total;
  return most < 0x7f800000;
}

static void step(const float* restrict numbers, float scale, int64_t count, const float* restrict gradient,
                 float* restrict parameters, float* restrict first, float* restrict second) {
  const float size = numbers[STEP], decay = numbers[FIRST_DECAY], other_decay = numbers[SECOND_DECAY];
  const float correction = numbers[SECOND_CORRECTION], tiny = numbers[TINY];
  for (int64_t k = 0; k < count; ++k) {
    const float g = scale * gradient[k];
    const float m = decay * first[k] + (1.0f - decay) * g;
    const float v = other_decay * second[k] + (1.0f - other_decay) * g * g;
    first[k] = m, second[k] = v;
    parameters[k] -= size * m / (sqrtf(v * correction) + tiny);
  }
}

static void follow(float rate, int64_t count, const float* restrict parameters, float* restrict follower) {
  for (int64_t k = 0; k < count; ++k) follower[k] = rate * parameters[k] + (1.0f - rate) * follower[k];
}

XLA_FFI_Error* edqn_adam(XLA_FFI_CallFrame* call) {
  if (asked_for_version(call)) return 0;
  const float *numbers = operand(call, 0), *gradient = operand(call, GRADIENT);
  const int64_t count = ((const XLA_FFI_Buffer*)call->args.args[GRADIENT])->dims[0];
  const int changed = (int)call->args.size - PARAMETERS; /* results before the last, of the operands from there on */
  for (int i = 0; i < changed; ++i)
    if (result(call, i) != operand(call, PARAMETERS + i))
      memcpy(result(call, i), operand(call, PARAMETERS + i), count * sizeof(float));
  float squares;
  const int finite = measure(gradient, count, &squares);
  *(uint8_t*)((XLA_FFI_Buffer*)call->rets.rets[changed])->data = (uint8_t)finite;
  if (!finite) return 0;
  float scale = numbers[SCALE];
  const float norm = sqrtf(squares) * scale;
  if (numbers[MOST_NORM] > 0.0f && norm >= numbers[MOST_NORM]) scale *= numbers[MOST_NORM] / norm;
  for (int64_t from = 0; from < count; from += BLOCK) {
    const int64_t size = count - from < BLOCK ? count - from : BLOCK;
    float* parameters = result(call, 0) + from;
    step(numbers, scale, size, gradient + from, parameters, result(call, 1) + from, result(call, 2) + from);
    for (int i = FOLLOWERS; i < changed + PARAMETERS; ++i)
      follow(numbers[FOLLOWER_RATES + i - FOLLOWERS], size, parameters, result(call, i - PARAMETERS) + from);
  }
  return 0;
}
