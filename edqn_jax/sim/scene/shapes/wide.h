/* Vectors of WIDE numbers, as many as this processor has instructions for, to which `field_rays.h` does the same: 16
 * with AVX-512, else 8, and 4 without AVX. Whoever includes this says what a function is (FN), and WIDE 1 for a thread
 * a number.
 */

#ifndef EDQN_WIDE_H
#define EDQN_WIDE_H

#include <math.h>
#include <stdint.h>

#if !defined(WIDE) && (defined(__AVX512F__) || defined(__AVX2__))
#include <immintrin.h>
#endif

#if defined(WIDE)

typedef float Wide;
typedef int32_t Whole; /* and of comparisons: whether they hold */

FN Wide wide(float x) { return x; }
FN Whole whole(int32_t x) { return x; }
FN Wide wide_at(const float* from) { return *from; }
FN void keep(float* to, Wide x) { *to = x; }
FN Wide choose(Whole where, Wide a, Wide b) { return where ? a : b; }
FN Wide smaller(Wide a, Wide b) { return a < b ? a : b; }
FN Wide larger(Wide a, Wide b) { return a > b ? a : b; }
FN Wide size_of(Wide x) { return fabsf(x); }
FN Wide root(Wide x) { return sqrtf(x); }
FN Whole floored(Wide x) { return (int32_t)x; }
FN Wide as_wide(Whole x) { return (float)x; }
FN Wide gathered(const float* from, Whole at) { return from[at]; }
FN void gathered_pair(const int16_t* from, Whole at, Wide* first, Wide* second) {
  *first = from[at], *second = from[at + 1];
}
FN int any(Whole where) { return where; }

#else

#ifdef __AVX512F__
#define WIDE 16
#elif defined(__SSE2__) && !defined(__AVX__)
#define WIDE 4
#else
#define WIDE 8
#endif

typedef float Wide __attribute__((vector_size(4 * WIDE)));
typedef float WideAnywhere __attribute__((vector_size(4 * WIDE), aligned(4)));
typedef int32_t Whole __attribute__((vector_size(4 * WIDE))); /* and of comparisons: -1 where they hold */

FN Wide wide(float x) { return x - (Wide){0}; }
FN Whole whole(int32_t x) { return x - (Whole){0}; }
FN Wide wide_at(const float* from) { return *(const WideAnywhere*)from; }
FN void keep(float* to, Wide x) { *(WideAnywhere*)to = x; }
FN Wide choose(Whole where, Wide a, Wide b) { return (Wide)((where & (Whole)a) | (~where & (Whole)b)); }
FN Wide size_of(Wide x) { return (Wide)((Whole)x & 0x7fffffff); }
FN Whole floored(Wide x) { return __builtin_convertvector(x, Whole); }
FN Wide as_wide(Whole x) { return __builtin_convertvector(x, Wide); }

#if WIDE == 16
FN Wide smaller(Wide a, Wide b) { return (Wide)_mm512_min_ps((__m512)a, (__m512)b); }
FN Wide larger(Wide a, Wide b) { return (Wide)_mm512_max_ps((__m512)a, (__m512)b); }
FN Wide root(Wide x) { return (Wide)_mm512_sqrt_ps((__m512)x); }
FN Wide gathered(const float* from, Whole at) { return (Wide)_mm512_i32gather_ps((__m512i)at, from, 4); }
FN Whole pairs(const int16_t* from, Whole at) { return (Whole)_mm512_i32gather_epi32((__m512i)at, from, 2); }
FN int any(Whole where) { return _mm512_test_epi32_mask((__m512i)where, (__m512i)where) != 0; }
#else
FN Wide root(Wide x) {
  for (int l = 0; l < WIDE; ++l) x[l] = sqrtf(x[l]);
  return x;
}
FN int any(Whole where) {
  int32_t found = 0;
  for (int l = 0; l < WIDE; ++l) found |= where[l];
  return found;
}
#ifdef __AVX2__
FN Wide smaller(Wide a, Wide b) { return (Wide)_mm256_min_ps((__m256)a, (__m256)b); }
FN Wide larger(Wide a, Wide b) { return (Wide)_mm256_max_ps((__m256)a, (__m256)b); }
FN Wide gathered(const float* from, Whole at) { return (Wide)_mm256_i32gather_ps(from, (__m256i)at, 4); }
FN Whole pairs(const int16_t* from, Whole at) { return (Whole)_mm256_i32gather_epi32((const int*)from, (__m256i)at, 2); }
#else
FN Wide smaller(Wide a, Wide b) { return choose(a < b, a, b); }
FN Wide larger(Wide a, Wide b) { return choose(a > b, a, b); }
FN Wide gathered(const float* from, Whole at) {
  Wide found;
  for (int l = 0; l < WIDE; ++l) found[l] = from[at[l]];
  return found;
}
#endif
#endif

/* Reads from[at] and from[at + 1]. */
FN void gathered_pair(const int16_t* from, Whole at, Wide* first, Wide* second) {
#if defined(__AVX512F__) || defined(__AVX2__) /* in one word: such processors have the first in its lower half */
  const Whole both = pairs(from, at);
  *first = as_wide((both << 16) >> 16), *second = as_wide(both >> 16);
#else
  for (int l = 0; l < WIDE; ++l) (*first)[l] = from[at[l]], (*second)[l] = from[at[l] + 1];
#endif
}

#endif

#endif
