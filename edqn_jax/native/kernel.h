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
#endif
