/* What all handlers of XLA's foreign function interface have in common (`build.py`). */

#ifndef EDQN_HANDLER_H
#define EDQN_HANDLER_H

#include "xla/ffi/api/c_api.h"

/* Returns whether XLA asks for a handler's version rather than calls it, and answers. What kernels are launched on a
 * stream can be recorded there and launched again. */
static inline int asked_for_version(XLA_FFI_CallFrame* call) {
  /* The base of extensions has another name in each version of XLA. */
  const XLA_FFI_Metadata_Extension* extension = (const XLA_FFI_Metadata_Extension*)call->extension_start;
  if (!extension || extension->extension_base.type != XLA_FFI_Extension_Metadata) return 0;
  XLA_FFI_Metadata* metadata = extension->metadata;
  metadata->api_version.major_version = XLA_FFI_API_MAJOR;
  metadata->api_version.minor_version = XLA_FFI_API_MINOR;
#ifdef __CUDACC__
  metadata->traits = XLA_FFI_HANDLER_TRAITS_COMMAND_BUFFER_COMPATIBLE;
#endif
  return 1;
}

/* Returns an error for XLA to raise. */
static inline XLA_FFI_Error* failed(XLA_FFI_CallFrame* call, XLA_FFI_Error_Code code, const char* message) {
  XLA_FFI_Error_Create_Args args = {XLA_FFI_Error_Create_Args_STRUCT_SIZE, 0, message, code};
  return call->api->XLA_FFI_Error_Create(&args);
}

#endif
