/* Products of matrices in bfloat16 with sums in float32, for CPUs with AMX, or without it by AVX-512's dot products of
 * pairs: handlers of XLA's foreign function interface (`products.py` registers them).
 *
 * Factors come in float32 and are rounded to the nearest bfloat16, ties to even. Both are packed in tiles of 1 KB, as
 * AMX wants them: of the left factor 16 rows of 32 numbers, of the right one 16 columns of 32 numbers in pairs.
 */

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "handler.h"

#if defined(__x86_64__) && defined(__linux__) && \
    (defined(__clang__) ? __clang_major__ >= 12 : defined(__GNUC__) && __GNUC__ >= 11)

#include <cpuid.h>
#include <immintrin.h>
#include <sys/syscall.h>
#include <unistd.h>

#define TILE 512   /* bfloat16 numbers in a tile */
#define ROWS 16    /* of the left factor's tile, and columns of the right one's */
#define DEPTH 32   /* of both: the sum runs over these */
#define BLOCK 1024 /* numbers that are summed before the next are packed, a multiple of DEPTH */

#ifdef WITHOUT_AMX /* a test of what AMD's processors take, on any */
#define USES_AMX 0
#define USES_DOTS 1
#else
#define USES_AMX 1
#define USES_DOTS __builtin_cpu_supports("sse4a")
#endif

#define WITH_AVX512 __attribute__((target("avx512f,avx512bw,avx512vl,avx512dq,avx512bf16")))
#define WITH_AMX __attribute__((target("avx512f,avx512bw,avx512vl,avx512dq,avx512bf16,amx-tile,amx-bf16")))

/* A factor in float32 as its tiles want it: `across` is the side that stays, `along` the one that is summed over. */
typedef struct {
  const float* data;
  int64_t across, along;
  int along_first; /* whether memory is [along, across], row by row, or [across, along] */
} Factor;

/* Whether the processor has AMX for bfloat16, and the system gives this process its registers. */
static int has_amx(void) {
  unsigned a, b, c, d;
  if (!USES_AMX) return 0;
  if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || !(d >> 22 & 1) || !(d >> 24 & 1)) return 0;
  /* Linux gives a process the tiles' registers when it asks for them: ARCH_REQ_XCOMP_PERM, XTILEDATA. */
  return syscall(SYS_arch_prctl, 0x1023, 18) == 0;
}

/* Returns why products are not faster here in bfloat16 than in float32; NULL if they are. Without AMX they are on AMD's
 * processors alone, see `products.py`. */
static const char* find_fault(void) {
  unsigned a, b, c, d;
  if (!__builtin_cpu_supports("avx512bw") || !__builtin_cpu_supports("avx512vl") ||
      !__builtin_cpu_supports("avx512dq") || !__get_cpuid_count(7, 1, &a, &b, &c, &d) || !(a >> 5 & 1))
    return "this processor has no bfloat16 in AVX-512";
  if (has_amx() || USES_DOTS) return 0;
  return "the system does not give this process AMX";
}

/* Transposes 16 rows of 16 numbers of 32 bits. */
WITH_AVX512 static inline void transpose(__m512i r[16]) {
  __m512i t[16];
  for (int i = 0; i < 16; i += 2) {
    t[i] = _mm512_unpacklo_epi32(r[i], r[i + 1]);
    t[i + 1] = _mm512_unpackhi_epi32(r[i], r[i + 1]);
  }
  for (int i = 0; i < 16; i += 4) {
    r[i] = _mm512_unpacklo_epi64(t[i], t[i + 2]);
    r[i + 1] = _mm512_unpackhi_epi64(t[i], t[i + 2]);
    r[i + 2] = _mm512_unpacklo_epi64(t[i + 1], t[i + 3]);
    r[i + 3] = _mm512_unpackhi_epi64(t[i + 1], t[i + 3]);
  }
  for (int i = 0; i < 4; ++i) {
    t[i] = _mm512_shuffle_i32x4(r[i], r[i + 4], 0x88);
    t[i + 4] = _mm512_shuffle_i32x4(r[i], r[i + 4], 0xdd);
    t[i + 8] = _mm512_shuffle_i32x4(r[i + 8], r[i + 12], 0x88);
    t[i + 12] = _mm512_shuffle_i32x4(r[i + 8], r[i + 12], 0xdd);
  }
  for (int i = 0; i < 8; ++i) {
    r[i] = _mm512_shuffle_i32x4(t[i], t[i + 8], 0x88);
    r[i + 8] = _mm512_shuffle_i32x4(t[i], t[i + 8], 0xdd);
  }
}

/* Packs one tile: pairs of the sum's numbers stand side by side; in rows of `across` where `by_row`, as the left
 * factor's, else of pairs, as the right one's. What lies beyond the factor is 0. */
WITH_AVX512 static inline void pack(uint16_t* to, const Factor* from, int64_t across, int64_t along, int by_row) {
  const int64_t wide = from->across - across < ROWS ? from->across - across : ROWS;
  const int64_t deep = from->along - along < DEPTH ? from->along - along : DEPTH;
  const int64_t stride = from->along_first ? from->across : from->along;
  __m512i lines[16];       /* of 16 pairs each */
  if (from->along_first) { /* a row of memory has one number of each pair: line p is of pair p, over `across` */
    const __m512i halves = _mm512_set_epi16(31, 15, 30, 14, 29, 13, 28, 12, 27, 11, 26, 10, 25, 9, 24, 8, 23, 7, 22, 6,
                                            21, 5, 20, 4, 19, 3, 18, 2, 17, 1, 16, 0);
    const __mmask16 some = (__mmask16)((1u << wide) - 1u);
    const float* row = from->data + along * stride + across;
    for (int p = 0; p < 16; ++p) {
      const __m512 first = 2 * p < deep ? _mm512_maskz_loadu_ps(some, row + 2 * p * stride) : _mm512_setzero_ps();
      const __m512 second =
          2 * p + 1 < deep ? _mm512_maskz_loadu_ps(some, row + (2 * p + 1) * stride) : _mm512_setzero_ps();
      lines[p] = _mm512_permutexvar_epi16(halves, (__m512i)_mm512_cvtne2ps_pbh(second, first));
    }
  } else { /* a row of memory has whole pairs: line i is of row i, over the pairs */
    const __mmask16 first_half = (__mmask16)((1u << (deep < 16 ? deep : 16)) - 1u);
    const __mmask16 second_half = (__mmask16)(deep > 16 ? (1u << (deep - 16)) - 1u : 0u);
    const float* row = from->data + across * stride + along;
    for (int i = 0; i < 16; ++i) {
      if (i < wide) {
        const __m512 first = _mm512_maskz_loadu_ps(first_half, row + i * stride);
        const __m512 second = _mm512_maskz_loadu_ps(second_half, row + i * stride + 16);
        lines[i] = (__m512i)_mm512_cvtne2ps_pbh(second, first);
      } else {
        lines[i] = _mm512_setzero_si512();
      }
    }
  }
  if (from->along_first == by_row) transpose(lines);
  for (int i = 0; i < 16; ++i) _mm512_store_si512(to + 32 * i, lines[i]);
}

/* Adds 16 rows of 16 numbers to what stands there, or writes them where the sum begins; `high` and `wide` are in it. */
WITH_AVX512 static inline void store(float* to, int64_t stride, const float* found, int64_t high, int64_t wide,
                                     int begins) {
  const __mmask16 some = (__mmask16)(wide >= 16 ? 0xffffu : (1u << wide) - 1u);
  for (int i = 0; i < 16 && i < high; ++i) {
    __m512 row = _mm512_load_ps(found + 16 * i);
    if (!begins) row = _mm512_add_ps(row, _mm512_maskz_loadu_ps(some, to + i * stride));
    _mm512_mask_storeu_ps(to + i * stride, some, row);
  }
}

typedef struct {
  uint8_t palette, start_row, reserved[14];
  uint16_t bytes[16];
  uint8_t rows[16];
} __attribute__((packed)) Layout;

/* Kept in memory: GCC does not know that the instruction reads more than its first bytes. */
static const Layout layout = {
    .palette = 1, .bytes = {64, 64, 64, 64, 64, 64, 64, 64}, .rows = {16, 16, 16, 16, 16, 16, 16, 16}};

/* Multiplies two tiles of rows by two of columns, `depth` tiles deep; steps are from one tile to the other, `left_step`
 * 0 where there is but one of rows. */
typedef void Multiply(float* found, const uint16_t* left, const uint16_t* right, int64_t depth, int64_t left_step,
                      int64_t right_step);

WITH_AMX static void multiply_by_amx(float* found, const uint16_t* left, const uint16_t* right, int64_t depth,
                                     int64_t left_step, int64_t right_step) {
  _tile_zero(0);
  _tile_zero(1);
  _tile_zero(2);
  _tile_zero(3);
  for (int64_t k = 0; k < depth; ++k) {
    _tile_loadd(4, left + k * TILE, 64);
    _tile_loadd(5, left + left_step + k * TILE, 64);
    _tile_loadd(6, right + k * TILE, 64);
    _tile_loadd(7, right + right_step + k * TILE, 64);
    _tile_dpbf16ps(0, 4, 6);
    _tile_dpbf16ps(1, 4, 7);
    _tile_dpbf16ps(2, 5, 6);
    _tile_dpbf16ps(3, 5, 7);
  }
  _tile_stored(0, found, 64);
  _tile_stored(1, found + 256, 64);
  _tile_stored(2, found + 512, 64);
  _tile_stored(3, found + 768, 64);
}

#define AT_ONCE 8 /* rows, whose sums fill half of the registers */

WITH_AVX512 static void multiply_by_dots(float* found, const uint16_t* left, const uint16_t* right, int64_t depth,
                                         int64_t left_step, int64_t right_step) {
  for (int first = 0; first < (left_step ? 2 * ROWS : ROWS); first += AT_ONCE) {
    const uint16_t* rows = left + first / ROWS * left_step + first % ROWS * DEPTH;
    __m512 sums[AT_ONCE][2];
    for (int i = 0; i < AT_ONCE; ++i) sums[i][0] = sums[i][1] = _mm512_setzero_ps();
    for (int64_t k = 0; k < depth; ++k)
      for (int p = 0; p < DEPTH / 2; ++p) {
        const uint16_t* of = right + k * TILE + p * DEPTH;
        const __m512bh one = (__m512bh)_mm512_load_si512(of), other = (__m512bh)_mm512_load_si512(of + right_step);
        for (int i = 0; i < AT_ONCE; ++i) {
          int32_t pair;
          memcpy(&pair, rows + k * TILE + i * DEPTH + 2 * p, sizeof pair);
          const __m512bh row = (__m512bh)_mm512_set1_epi32(pair);
          sums[i][0] = _mm512_dpbf16_ps(sums[i][0], row, one), sums[i][1] = _mm512_dpbf16_ps(sums[i][1], row, other);
        }
      }
    float* to = found + first / ROWS * 512 + first % ROWS * 16;
    for (int i = 0; i < AT_ONCE; ++i)
      _mm512_store_ps(to + 16 * i, sums[i][0]), _mm512_store_ps(to + 256 + 16 * i, sums[i][1]);
  }
}

/* Writes left times right to `to` [left.across, right.across]. */
WITH_AVX512 static void multiply(const Factor* left, const Factor* right, float* to, uint16_t* scratch,
                                 Multiply* tiles) {
  const int64_t columns = (right->across + ROWS - 1) / ROWS, pairs = (columns + 1) / 2;
  uint16_t* const rows = scratch; /* of two tiles of rows, then all of the right factor's */
  uint16_t* const packed = scratch + 2 * BLOCK / DEPTH * TILE;
  float found[1024] __attribute__((aligned(64)));
  for (int64_t from = 0; from < left->along; from += BLOCK) {
    const int64_t end = left->along < from + BLOCK ? left->along : from + BLOCK;
    const int64_t depth = (end - from + DEPTH - 1) / DEPTH;
    for (int64_t j = 0; j < columns; ++j)
      for (int64_t k = 0; k < depth; ++k) pack(packed + (j * depth + k) * TILE, right, j * ROWS, from + k * DEPTH, 0);
    if (columns & 1) memset(packed + columns * depth * TILE, 0, depth * TILE * sizeof(uint16_t));
    for (int64_t i = 0; i < left->across; i += 2 * ROWS) {
      const int second = i + ROWS < left->across;
      for (int64_t k = 0; k < depth; ++k) {
        pack(rows + k * TILE, left, i, from + k * DEPTH, 1);
        if (second) pack(rows + (depth + k) * TILE, left, i + ROWS, from + k * DEPTH, 1);
      }
      for (int64_t j = 0; j < pairs; ++j) {
        const uint16_t* pair = packed + 2 * j * depth * TILE;
        tiles(found, rows, pair, depth, second ? depth * TILE : 0, depth * TILE);
        for (int t = 0; t < 4; ++t) {
          const int64_t down = i + (t >> 1) * ROWS, across = (2 * j + (t & 1)) * ROWS;
          if (down < left->across && across < right->across)
            store(to + down * right->across + across, right->across, found + 256 * t, left->across - down,
                  right->across - across, from == 0);
        }
      }
    }
  }
}

/* Multiplies `many` pairs of factors that stand one after the other. */
WITH_AVX512 static void multiply_each(Factor left, Factor right, float* to, int64_t many, uint16_t* scratch,
                                      Multiply* tiles) {
  for (int64_t i = 0; i < many; ++i) {
    multiply(&left, &right, to, scratch, tiles);
    left.data += left.across * left.along;
    right.data += right.across * right.along;
    to += left.across * right.across;
  }
}

WITH_AMX static void multiply_each_by_amx(Factor left, Factor right, float* to, int64_t many, uint16_t* scratch) {
  _tile_loadconfig(&layout);
  multiply_each(left, right, to, many, scratch, multiply_by_amx);
  _tile_release();
}

static int by_amx; /* set before the first product */

/* Returns room that this thread keeps, of at least so many bytes; NULL if there is none. */
static uint16_t* scratch_of(size_t bytes) {
  static _Thread_local uint16_t* held;
  static _Thread_local size_t size;
  if (bytes > size) {
    free(held);
    held = aligned_alloc(64, bytes);
    size = held ? bytes : 0;
  }
  return held;
}

/* Multiplies `many` pairs of factors, [along, across] or [across, along] each, that stand one after the other. */
static int multiply_all(const Factor* left, const Factor* right, float* to, int64_t many) {
  const int64_t columns = (right->across + 2 * ROWS - 1) / (2 * ROWS) * 2;
  uint16_t* scratch = scratch_of((size_t)((2 + columns) * (BLOCK / DEPTH) * TILE) * sizeof(uint16_t));
  if (!scratch) return 0;
  if (by_amx)
    multiply_each_by_amx(*left, *right, to, many, scratch);
  else
    multiply_each(*left, *right, to, many, scratch, multiply_by_dots);
  return 1;
}

const char* edqn_unusable_products(void) {
  by_amx = has_amx();
  return find_fault();
}

/* Returns a factor [..., along, across] or [..., across, along]. */
static Factor factor_of(const XLA_FFI_Buffer* buffer, int along_first) {
  const int64_t *dims = buffer->dims + buffer->rank - 2, along = dims[!along_first], across = dims[along_first];
  const Factor factor = {buffer->data, across, along, along_first};
  return factor;
}

static XLA_FFI_Error* product(XLA_FFI_CallFrame* call, int left_along_first, int right_along_first) {
  if (asked_for_version(call)) return 0;
  const XLA_FFI_Buffer *a = call->args.args[0], *b = call->args.args[1], *to = call->rets.rets[0];
  const Factor left = factor_of(a, left_along_first), right = factor_of(b, right_along_first);
  if (a->dtype != XLA_FFI_DataType_F32 || b->dtype != XLA_FFI_DataType_F32 || to->dtype != XLA_FFI_DataType_F32)
    return failed(call, XLA_FFI_Error_Code_INVALID_ARGUMENT, "products.c multiplies float32 alone");
  int64_t many = 1;
  for (int64_t i = 0; i < to->rank - 2; ++i) many *= to->dims[i];
  if (!multiply_all(&left, &right, to->data, many))
    return failed(call, XLA_FFI_Error_Code_RESOURCE_EXHAUSTED, "products.c has no memory for its tiles");
  return 0;
}

/* [..., M, K] times [..., K, N]. */
XLA_FFI_Error* edqn_product(XLA_FFI_CallFrame* call) { return product(call, 0, 1); }

/* [..., M, N] times [..., K, N] transposed: the gradient of the rows. */
XLA_FFI_Error* edqn_product_nt(XLA_FFI_CallFrame* call) { return product(call, 0, 0); }

/* [..., M, K] transposed times [..., M, N]: the gradient of the kernel. */
XLA_FFI_Error* edqn_product_tn(XLA_FFI_CallFrame* call) { return product(call, 1, 1); }

#endif
