/* Runs kernels of CUDA on a CPU, one thread of a block after another: `cc -include` this before a source of kernels.
 *
 * Every thread of a block runs until it waits for the others; when all do, they go on. All threads have to wait equally
 * often, which a GPU asks for as well and does not check. In every other block the last thread runs first, so that what
 * one reads before another has written it shows. There is no warp, and shared memory is that of the process.
 */

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <ucontext.h>

#define __device__
#define __global__
#define __forceinline__ inline
#define __shared__ static
#define __align__(bytes)
#define __launch_bounds__(threads, resident)
#define EXPORTED
#define STREAM(call, stream) 0
#define LAUNCH_ERROR() 0
#define LAUNCH(kernel, blocks, stream, batch) \
  do {                                        \
    launched = &(batch);                      \
    for (int64_t b = 0; b < (blocks); ++b) {  \
      blockIdx.x = (int)b;                    \
      run_block(call_##kernel, THREADS);      \
    }                                         \
  } while (0)
#define KERNEL_ON_CPU(kernel) \
  static void call_##kernel(void) { kernel(*(const Batch*)launched); }

#define MOST_THREADS 1024
#define STACK 65536

static struct {
  int x;
} threadIdx, blockIdx;

static ucontext_t scheduler, threads[MOST_THREADS];
static char* stacks;
static int ended[MOST_THREADS], waits, counts[2];

static void __syncthreads(void) {
  const int self = threadIdx.x;
  swapcontext(&threads[self], &scheduler);
}

static int __syncthreads_count(int holds) {
  const int which = waits & 1;
  counts[which] += holds != 0;
  __syncthreads();
  return counts[which];
}

static int __popc(unsigned x) { return __builtin_popcount(x); }
static int __ffs(int x) { return __builtin_ffs(x); }
static unsigned atomicOr(unsigned* at, unsigned x) { return *at |= x; }

static void (*body)(void);
static const void* launched;

static void run_thread(void) {
  body();
  ended[threadIdx.x] = 1;
}

static void run_block(void (*kernel)(void), int size) {
  if (!stacks) stacks = malloc((size_t)MOST_THREADS * STACK);
  body = kernel, waits = 0;
  memset(ended, 0, sizeof ended);
  for (int t = 0; t < size; ++t) {
    getcontext(&threads[t]);
    threads[t].uc_stack.ss_sp = stacks + (size_t)t * STACK;
    threads[t].uc_stack.ss_size = STACK;
    threads[t].uc_link = &scheduler;
    makecontext(&threads[t], run_thread, 0);
  }
  for (int left = size; left; ++waits) {
    counts[waits & 1] = 0; /* of two waits ago; those of the last are read in this round */
    left = 0;
    for (int i = 0; i < size; ++i) {
      const int t = blockIdx.x & 1 ? size - 1 - i : i; /* in either order: none may count on the other's */
      threadIdx.x = t;
      swapcontext(&scheduler, &threads[t]);
      left += !ended[t];
    }
    if (left && left != size) {
      fprintf(stderr, "%d of %d threads wait for others that have ended\n", left, size);
      abort();
    }
  }
}
