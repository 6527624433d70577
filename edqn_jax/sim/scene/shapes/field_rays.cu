/* Where rays meet fields, for NVIDIA GPUs, as a handler of XLA's foreign function interface (`field_rays.py` compiles
 * and registers it): a thread a ray, by itself. How is in `field_rays.h`. A test runs the kernel on a CPU
 * (`tests/oracles/cuda_on_cpu.h`).
 */

#include "kernel.h"

#define FN static __device__ __forceinline__
#define WIDE 1
#define THREADS 128

#include "field_batch.h"

static __global__ void __launch_bounds__(THREADS, 8) meet(const Batch batch) {
  const int64_t i = (int64_t)blockIdx.x * THREADS + threadIdx.x;
  if (i >= batch.rows * batch.fields * batch.count) return;
  const int64_t ray = i % batch.count, one = i / batch.count;
  draw_some(&batch, (uint32_t)(one / batch.fields), one % batch.fields, ray, ray + 1);
}

KERNEL_ON_CPU(meet)

EXPORTED XLA_FFI_Error* edqn_field_rays(XLA_FFI_CallFrame* call) {
  if (asked_for_version(call)) return 0;
  Batch batch;
  XLA_FFI_Error* error = batch_of(call, &batch);
  const int64_t rays = error ? 0 : batch.rows * batch.fields * batch.count;
  if (error || !rays) return error;
  RETURN_LAUNCHED(meet, (rays + THREADS - 1) / THREADS, call, batch);
}

EXPORT_UNUSABLE(field_rays)
