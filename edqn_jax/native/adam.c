/* A step of Adam (Kingma & Ba 2015) on vectors of parameters, for CPUs: a handler of XLA's foreign function
 * interface (`adam.py` registers it).
 *
 * XLA passes over the numbers a dozen times, here it is twice: once for the gradient's norm, and once for the rest, in
 * blocks that stay in the innermost cache. XLA gives results the memory of their operands.
 */

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "handler.h"

#define BLOCK 512
#define LANES 32

/* Of the first operand, in the order of `adam.py`; after them the rate of each follower. */
enum { SCALE, MAX_NORM, STEP, FIRST_DECAY, SECOND_DECAY, SECOND_CORRECTION, EPSILON, FOLLOWER_RATES };

enum { GRADIENT = 1, PARAMETERS }; /* operands; from PARAMETERS on they are changed */

#define FIRST_FOLLOWER 3 /* of what is changed, after parameters and both moments */
#define MOST_CHANGED (FIRST_FOLLOWER + 8)

static float* operand(const XLA_FFI_CallFrame* call, int i) { return ((XLA_FFI_Buffer*)call->args.args[i])->data; }
static float* result(const XLA_FFI_CallFrame* call, int i) { return ((XLA_FFI_Buffer*)call->rets.rets[i])->data; }

static inline void measure_one(float x, float* square, int32_t* largest) {
  int32_t bits; /* without the sign, since compilers may take it that floats are finite */
  memcpy(&bits, &x, sizeof bits);
  bits &= 0x7fffffff;
  *largest = bits > *largest ? bits : *largest;
  *square += x * x;
}

/* Returns whether all numbers are finite, and gives the sum of their squares. */
static int measure(const float* restrict x, int64_t count, float* restrict squares) {
  float sums[LANES] = {0}, total = 0.0f;
  int32_t largest[LANES] = {0}, most = 0;
  int64_t k = 0;
  for (; k + LANES <= count; k += LANES)
    for (int lane = 0; lane < LANES; ++lane) measure_one(x[k + lane], &sums[lane], &largest[lane]);
  for (int lane = 0; k < count; ++k, ++lane) measure_one(x[k], &sums[lane], &largest[lane]);
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
  const float correction = numbers[SECOND_CORRECTION], epsilon = numbers[EPSILON];
  for (int64_t k = 0; k < count; ++k) {
    const float g = scale * gradient[k];
    const float m = decay * first[k] + (1.0f - decay) * g;
    const float v = other_decay * second[k] + (1.0f - other_decay) * g * g;
    first[k] = m, second[k] = v;
    parameters[k] -= size * m / (sqrtf(v * correction) + epsilon);
  }
}

static void follow(float rate, int64_t count, const float* restrict parameters, float* restrict follower) {
  for (int64_t k = 0; k < count; ++k) follower[k] = rate * parameters[k] + (1.0f - rate) * follower[k];
}

/* Steps along one gradient. `changed`: parameters, moments and followers, in place. Returns whether it was finite. */
static int step_all(const float* numbers, const float* gradient, int64_t count, float* const* changed, int followers) {
  float squares;
  if (!measure(gradient, count, &squares)) return 0;
  float scale = numbers[SCALE];
  const float norm = sqrtf(squares) * scale;
  if (numbers[MAX_NORM] >= 0.0f && norm >= numbers[MAX_NORM]) scale *= numbers[MAX_NORM] / norm;
  for (int64_t from = 0; from < count; from += BLOCK) {
    const int64_t size = count - from < BLOCK ? count - from : BLOCK;
    float* parameters = changed[0] + from;
    step(numbers, scale, size, gradient + from, parameters, changed[1] + from, changed[2] + from);
    for (int i = 0; i < followers; ++i)
      follow(numbers[FOLLOWER_RATES + i], size, parameters, changed[FIRST_FOLLOWER + i] + from);
  }
  return 1;
}

XLA_FFI_Error* edqn_adam(XLA_FFI_CallFrame* call) {
  if (asked_for_version(call)) return 0;
  const XLA_FFI_Buffer *given = call->args.args[0], *gradients = call->args.args[GRADIENT];
  const int64_t amount = given->dims[given->rank - 1], count = gradients->dims[gradients->rank - 1];
  int64_t vectors = 1;
  for (int i = 0; i < gradients->rank - 1; ++i) vectors *= gradients->dims[i];
  const int all = (int)call->rets.size - 1; /* that are changed; whether gradients were finite comes last */
  if (all > MOST_CHANGED) return failed(call, XLA_FFI_Error_Code_INVALID_ARGUMENT, "adam.c moves at most 8 averages");
  float* changed[MOST_CHANGED];
  for (int i = 0; i < all; ++i) {
    changed[i] = result(call, i);
    if (changed[i] != operand(call, PARAMETERS + i))
      return failed(call, XLA_FFI_Error_Code_INTERNAL, "adam.c changes its operands in place, and was given copies");
  }
  uint8_t* finite = ((XLA_FFI_Buffer*)call->rets.rets[all])->data;
  for (int64_t vector = 0; vector < vectors; ++vector) {
    finite[vector] = (uint8_t)step_all(operand(call, 0) + vector * amount, operand(call, GRADIENT) + vector * count,
                                       count, changed, all - FIRST_FOLLOWER);
    for (int i = 0; i < all; ++i) changed[i] += count;
  }
  return 0;
}
