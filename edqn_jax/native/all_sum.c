/* The sum of arrays over the devices of one process, for CPUs: a handler of XLA's foreign function interface
 * (`all_sum.py` registers it).
 *
 * XLA's own sum lets a device sleep several times until another has arrived, and waking up takes longer than the sum.
 * Here devices spin at first, since each has a thread and all arrive at about the same time. The devices of one
 * execution meet in a place that nobody else uses meanwhile; each adds up its share of the elements, in the order of
 * the devices, and writes it to the results of all.
 */

#include <sched.h>
#include <stdatomic.h>
#include <stdint.h>
#include <time.h>

#include "handler.h"

#define MOST_DEVICES 256
#define PLACES 64
#define SPIN_US 300        /* after which a device leaves its core to others, which may be what it waits for */
#define NAP_US 20          /* at a time */
#define MOST_NAPS 10000000 /* ten minutes or so; naps are counted, so that a process may be stopped for longer */

typedef struct {
  int taken;
  int64_t run;  /* of the execution that meets here */
  int expected; /* devices */
  atomic_int arrived, done, left, failed;
  XLA_FFI_CallFrame* calls[MOST_DEVICES];
} Place;

static Place places[PLACES];
static atomic_flag busy = ATOMIC_FLAG_INIT; /* held while a place is looked for or given back */

static void lock(void) {
  while (atomic_flag_test_and_set_explicit(&busy, memory_order_acquire)) sched_yield();
}

static void unlock(void) { atomic_flag_clear_explicit(&busy, memory_order_release); }

/* Returns where the execution `run` meets now, with this device registered; NULL if all places are taken. */
static Place* arrive(int64_t run, int expected, int rank, XLA_FFI_CallFrame* call) {
  Place* here = 0;
  lock();
  for (int i = 0; i < PLACES && !here; ++i)
    if (places[i].taken && places[i].run == run && places[i].expected == expected &&
        atomic_load(&places[i].arrived) < expected)
      here = &places[i];
  for (int i = 0; i < PLACES && !here; ++i)
    if (!places[i].taken) {
      here = &places[i];
      here->taken = 1, here->run = run, here->expected = expected;
    }
  if (here) {
    here->calls[rank] = call;
    atomic_fetch_add(&here->arrived, 1);
  }
  unlock();
  return here;
}

static void leave(Place* here) {
  if (atomic_fetch_add(&here->left, 1) + 1 < here->expected) return;
  lock();
  atomic_store(&here->arrived, 0), atomic_store(&here->done, 0);
  atomic_store(&here->left, 0), atomic_store(&here->failed, 0);
  here->taken = 0;
  unlock();
}

static int64_t microseconds(void) {
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return (int64_t)now.tv_sec * 1000000 + now.tv_nsec / 1000;
}

/* Waits until `count` is `wanted`; returns 0 if that takes more than `most` naps. */
static int wait_for(atomic_int* count, int wanted, int64_t most) {
  const struct timespec nap = {0, 1000 * NAP_US};
  const int64_t began = microseconds();
  for (int64_t naps = 0; naps < most;) {
    for (int i = 0; i < 64; ++i) {
      if (atomic_load_explicit(count, memory_order_acquire) >= wanted) return 1;
#if defined(__x86_64__)
      __builtin_ia32_pause();
#endif
    }
    if (naps || microseconds() - began > SPIN_US) nanosleep(&nap, 0), ++naps;
  }
  return 0;
}

/* Waits for all devices; returns 0 if one has not come in time, for every device alike, so that none reads what another
 * has given up. */
static int all_arrived(Place* here) {
  const int in_time = wait_for(&here->arrived, here->expected, MOST_NAPS);
  lock();
  if (!in_time && atomic_load(&here->arrived) < here->expected) atomic_store(&here->failed, 1);
  unlock();
  return !atomic_load(&here->failed);
}

static int64_t elements(const XLA_FFI_Buffer* buffer) {
  int64_t count = 1;
  for (int i = 0; i < buffer->rank; ++i) count *= buffer->dims[i];
  return count;
}

static void* operand(const XLA_FFI_CallFrame* call, int i) { return ((XLA_FFI_Buffer*)call->args.args[i])->data; }
static void* result(const XLA_FFI_CallFrame* call, int i) { return ((XLA_FFI_Buffer*)call->rets.rets[i])->data; }

/* Operands before those that are summed: the device's number, how many there are, and what must come first. */
#define OPERANDS_BEFORE 3

#define CHUNK 1024 /* elements added at a time, so that they stay in the cache */

static void add_share(Place* here, int rank, const XLA_FFI_CallFrame* call) {
  for (int i = 0; i < call->rets.size; ++i) {
    const XLA_FFI_Buffer* buffer = (XLA_FFI_Buffer*)call->rets.rets[i];
    const int64_t count = elements(buffer), begin = count * rank / here->expected;
    const int64_t end = count * (rank + 1) / here->expected;
    if (buffer->dtype == XLA_FFI_DataType_S32) {
      for (int64_t k = begin; k < end; ++k) {
        int32_t total = 0;
        for (int d = 0; d < here->expected; ++d)
          total += ((const int32_t*)operand(here->calls[d], i + OPERANDS_BEFORE))[k];
        for (int d = 0; d < here->expected; ++d) ((int32_t*)result(here->calls[d], i))[k] = total;
      }
      continue;
    }
    for (int64_t first = begin; first < end; first += CHUNK) {
      const int64_t size = end - first < CHUNK ? end - first : CHUNK;
      float total[CHUNK];
      const float* own = (const float*)operand(here->calls[0], i + OPERANDS_BEFORE) + first;
      for (int64_t k = 0; k < size; ++k) total[k] = own[k];
      for (int d = 1; d < here->expected; ++d) {
        const float* more = (const float*)operand(here->calls[d], i + OPERANDS_BEFORE) + first;
        for (int64_t k = 0; k < size; ++k) total[k] += more[k];
      }
      for (int d = 0; d < here->expected; ++d) {
        float* to = (float*)result(here->calls[d], i) + first;
        for (int64_t k = 0; k < size; ++k) to[k] = total[k];
      }
    }
  }
}

XLA_FFI_Error* edqn_all_sum(XLA_FFI_CallFrame* call) {
  if (asked_for_version(call)) return 0;
  const int rank = *(const int32_t*)operand(call, 0), expected = *(const int32_t*)operand(call, 1);
  if (rank < 0 || rank >= expected || expected > MOST_DEVICES)
    return failed(call, XLA_FFI_Error_Code_INVALID_ARGUMENT, "all_sum.c adds over at most 256 devices");
  for (int i = 0; i < call->rets.size; ++i) {
    const XLA_FFI_DataType type = ((XLA_FFI_Buffer*)call->rets.rets[i])->dtype;
    if (type != XLA_FFI_DataType_F32 && type != XLA_FFI_DataType_S32)
      return failed(call, XLA_FFI_Error_Code_INVALID_ARGUMENT, "all_sum.c adds float32 and int32 alone");
  }
  XLA_FFI_RunId_Get_Args run = {XLA_FFI_RunId_Get_Args_STRUCT_SIZE, 0, call->ctx, 0};
  XLA_FFI_Error* error = call->api->XLA_FFI_RunId_Get(&run);
  if (error) return error;
  Place* here = arrive(run.run_id, expected, rank, call);
  if (!here) return failed(call, XLA_FFI_Error_Code_RESOURCE_EXHAUSTED, "all_sum.c serves at most 64 programs at once");
  if (!all_arrived(here)) {
    leave(here);
    return failed(call, XLA_FFI_Error_Code_DEADLINE_EXCEEDED,
                  "all_sum.c waited ten minutes for another device to arrive");
  }
  add_share(here, rank, call);
  atomic_fetch_add_explicit(&here->done, 1, memory_order_release);
  wait_for(&here->done, expected, INT64_MAX); /* all are adding, so this ends */
  leave(here);
  return 0;
}
