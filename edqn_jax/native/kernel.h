/* What sources of kernels have in common, each with its own THREADS of a block. A test gives other definitions, with
 * which they run on a CPU (`tests/oracles/cuda_on_cpu.h`).
 */

#ifndef LAUNCH
#include <cuda_runtime.h>
#define LAUNCH(kernel, blocks, stream, batch) kernel<<<(unsigned)(blocks), THREADS, 0, (cudaStream_t)(stream)>>>(batch)
#define KERNEL_ON_CPU(kernel)
#define EXPORTED extern "C"
#define STREAM(call, args) (call)->api->XLA_FFI_Stream_Get(args)
#define LAUNCH_ERROR() (cudaPeekAtLastError() == cudaSuccess ? 0 : cudaGetErrorString(cudaGetLastError()))

/* Exports why the kernels of source `name` cannot be run on this machine, or 0. Asks nothing that would take memory on
 * a card. */
#define EXPORT_UNUSABLE(name)                                                                                        \
  EXPORTED const char* edqn_unusable_##name(void) {                                                                  \
    int driver = 0, compiler = 0;                                                                                    \
    const cudaError_t error = cudaDriverGetVersion(&driver), other = cudaRuntimeGetVersion(&compiler);               \
    if (error != cudaSuccess || other != cudaSuccess) return cudaGetErrorString(error != cudaSuccess ? error : other); \
    return driver / 1000 < compiler / 1000 ? "the driver is of an older major version of CUDA than nvcc" : 0;         \
  }
#else
#define EXPORT_UNUSABLE(name)
#endif

/* Launches a kernel on `blocks` blocks of a call's batch, and returns what went wrong. */
#define RETURN_LAUNCHED(kernel, blocks, call, batch)                                                \
  XLA_FFI_Stream_Get_Args stream = {XLA_FFI_Stream_Get_Args_STRUCT_SIZE, 0, (call)->ctx, 0};        \
  error = STREAM(call, &stream);                                                                    \
  if (error) return error;                                                                          \
  LAUNCH(kernel, blocks, stream.stream, batch);                                                     \
  const char* said = LAUNCH_ERROR();                                                                \
  return said ? failed(call, XLA_FFI_Error_Code_INTERNAL, said) : 0
