/* Pictures and depth images for NVIDIA GPUs, as handlers of XLA's foreign function interface (`native.py` compiles and
 * registers them). What they are made of is in `pictures.h`; those of a camera on the body, in `tilted.h`.
 *
 * A block of threads draws a strip of COLUMNS columns of a frame, ROWS rows of it at a time, a thread a pixel. First it
 * gathers the upright shapes that the strip may show; then what its columns need of them goes into shared memory, of
 * each shape for the columns that it covers alone, from which the pixels read it. Written in C as CPUs have it too, so
 * that a test can run the kernels on one (`tests/oracles/cuda_on_cpu.h`).
 */

#include <assert.h>
#include <stdint.h>

#include "kernel.h"

#define LANES 1
#define FN static __device__ __forceinline__
#define UNROLLED _Pragma("unroll")
#define MEETINGS_AT_ONCE MEETINGS
#define FILLS_LAYERS 1
#define ALIGNED __align__(16)
#define COLUMNS 32
#define ROWS 4
#define RESIDENT 8 /* blocks that a multiprocessor holds at once: as many as its registers allow */
#define THREADS (COLUMNS * ROWS)
#define STAGED 16        /* shapes that are set up at once */
#define KEPT 64          /* that stay, 32 a word of `covering`, as far as there is room for what their columns need */
#define ROOM 5632        /* floats, before a level camera: 12 for each shape and column */
#define TILTED_ROOM 6144 /* the same before a camera on the body */
#define MOST_ACROSS 16   /* rays across a pixel: `camera.samples_across` */
#define MEASURED_AT_ONCE 32
#define TILTED_RESIDENT 4

typedef float Lanes;
typedef int Mask;

FN Lanes lanes(float x) { return x; }
FN Lanes load(const float* from) { return *from; }
FN void store(float* to, Lanes x) { *to = x; }
FN Lanes pick(Mask where, Lanes a, Lanes b) { return where ? a : b; }
FN Lanes lesser(Lanes a, Lanes b) { return a < b ? a : b; }
FN Lanes greater(Lanes a, Lanes b) { return a > b ? a : b; }
FN Lanes absolute(Lanes x) { return fabsf(x); }
FN Lanes roots(Lanes x) { return sqrtf(x); }
FN int any_of(Mask where) { return where; }
FN Lanes counted(void) { return 0; }
FN float highest(Lanes x) { return x; }

#include "pictures.h"
#include "tilted.h"

/* What the threads of a block share of their frame. */
typedef struct {
  const float* of[OPERANDS];
  Camera camera;
  Shapes shapes;
  Eye eye;
  Plane planes[MOST_PLANES];
} Frame;

/* Reads frame `m`. Every thread of the block calls it. */
FN void share_frame(const Batch* b, uint32_t m, Frame* f) {
  const int t = threadIdx.x;
  if (t < OPERANDS) f->of[t] = of_frame(b, t, m);
  __syncthreads();
  if (t == 0) {
    frame_of(b, f->of, &f->camera, &f->shapes, &f->eye);
    planes_of(&f->camera, &f->shapes, &f->eye, f->planes);
  }
  __syncthreads();
}

/* The upright shapes of a pass that a strip may show, in their order. */
typedef struct {
  unsigned bits[THREADS / 32]; /* by thread, a shape each */
  int list[THREADS];
} Gathered;

/* Adds shape `n` to the list if it is shown; returns how many are. Every thread of the block calls it. */
FN int gather(Gathered* g, int n, int shown) {
  const int t = threadIdx.x;
  if (t < THREADS / 32) g->bits[t] = 0;
  __syncthreads();
  if (shown) atomicOr(&g->bits[t / 32], 1u << t % 32);
  const int found = __syncthreads_count(shown);
  if (shown) {
    int before = __popc(g->bits[t / 32] & ((1u << t % 32) - 1));
    for (int word = 0; word < t / 32; ++word) before += __popc(g->bits[word]);
    g->list[before] = n;
  }
  __syncthreads(); /* the list is there, and the bits have been read, before the next pass clears them */
  return found;
}

/* Where a thread's pixels are: neighbours of a warp are 8 columns wide and 4 rows high. */
FN int column_of(int t) { return t % 8 + t / 32 % (COLUMNS / 8) * 8; }
FN int row_of(int t) { return t / 8 % 4 + t / 128 * 4; }

/* A shape that covers all columns finds room, else passes had no end; where a shape is, a thread of its own writes. */
static_assert(NUMBERS * COLUMNS <= ROOM && HEIGHTS(1, MOST_ACROSS) * COLUMNS <= TILTED_ROOM, "room for one shape");
static_assert(KEPT <= THREADS, "a thread for each shape");

/* Where the numbers of a shape are: those of each column that it covers one after the other, from column `first` of the
 * strip on. */
typedef struct {
  int begins, first, columns;
} Place;

/* The shapes of a list that a block has set up. */
typedef struct {
  Place places[KEPT];
  unsigned covering[KEPT / 32][COLUMNS]; /* which of them, a bit each */
} Book;

/* Begins anew. Every thread of the block calls it, as it does `reserve`. */
FN void clear_book(Book* book) {
  __syncthreads(); /* nobody reads the shapes of the pass before */
  if (threadIdx.x < COLUMNS)
    for (int word = 0; word < KEPT / 32; ++word) book->covering[word][threadIdx.x] = 0;
}

/* Returns how many shapes are set up next, where `rest` are left and `many` are kept. */
FN int next_of(int rest, int many) {
  const int most = KEPT - many < STAGED ? KEPT - many : STAGED;
  return rest < most ? rest : most;
}

/* Gives a shape that covers the columns [first, last) of the image its place, `numbers` for each, and returns whether
 * there is room; `used` floats are taken. */
FN int reserve(Book* book, int which, int first, int last, int left, int numbers, int room, int* used) {
  const int from = first > left ? first - left : 0, to = last < left + COLUMNS ? last - left : COLUMNS;
  const Place place = {*used, from, from < to ? to - from : 0};
  if (*used + numbers * place.columns > room) return 0;
  if (threadIdx.x == which) book->places[which] = place;
  *used += numbers * place.columns;
  return 1;
}

/* The upright shapes before a level camera. */
typedef struct {
  Book book;
  Upright staged[STAGED];
  float numbers[ROOM];
} LevelShapes;

/* Sets up the shapes of a list from `k` on, as many as find room, and returns how many; called by every thread. */
FN int set_up(const Frame* f, const int* list, int k, int found, int left, LevelShapes* to) {
  const Camera* c = &f->camera;
  const int t = threadIdx.x;
  int many = 0, used = 0, full = 0;
  clear_book(&to->book);
  while (!full && k + many < found) {
    const int staged = next_of(found - k - many, many);
    if (t < staged) upright(c, &f->shapes, &f->eye, list[k + many + t], &to->staged[t]);
    __syncthreads();
    int fit = 0;
    while (fit < staged &&
           reserve(&to->book, many + fit, to->staged[fit].first, to->staged[fit].last, left, NUMBERS, ROOM, &used))
      ++fit;
    __syncthreads();
    for (int task = t; task < fit * COLUMNS; task += THREADS) {
      const int which = many + task / COLUMNS, x = task % COLUMNS, at = x - to->book.places[which].first;
      if (at < 0 || at >= to->book.places[which].columns) continue;
      float* of = to->numbers + to->book.places[which].begins + NUMBERS * at;
      sides(c, &f->eye, &to->staged[task / COLUMNS], c->u[left + x], of, 1);
      if (of[SHARE] > 0) atomicOr(&to->book.covering[which / 32][x], 1u << which % 32);
    }
    __syncthreads();
    many += fit, full = fit < staged || many == KEPT;
  }
  return many;
}

static __global__ void __launch_bounds__(THREADS, RESIDENT) draw(const Batch batch) {
  __shared__ Frame frame;
  __shared__ Wave waves[MOST_WAVES];
  __shared__ Gathered gathered;
  __shared__ LevelShapes shapes;
  const int t = threadIdx.x, strips = (batch.width + COLUMNS - 1) / COLUMNS;
  const uint32_t m = blockIdx.x / strips;
  const int left = (int)(blockIdx.x % strips) * COLUMNS, right = left + COLUMNS;
  share_frame(&batch, m, &frame);
  const Camera* c = &frame.camera;
  const Shapes* s = &frame.shapes;
  const Eye* e = &frame.eye;
  if (t == THREADS - 1) waves_of(c, e, waves); /* in warps that have no shape of a usual scene to look at */
  if (t == THREADS - 33) light_planes(c, s, e, frame.planes);

  const int uprights = s->boxes + s->cylinders, across = column_of(t), column = left + across;
  const int in_image = column < c->width;
  float ahead[3];
  ray_ahead(e, c->u[in_image ? column : c->width - 1], ahead);
  int found = 0, many = 0, kept = 0; /* kept: all that is shown stays in shared memory */
  for (int first = 0; first < c->height; first += ROWS) {
    const int row = first + row_of(t), drawn = in_image && row < c->height;
    const float dz = c->v[row < c->height ? row : c->height - 1];
    Layers layers;
    layers.inserted = 0;
    if (drawn)
      for (int n = 0; n < s->spheres; ++n) insert_sphere(c, s, e, n, ahead, dz, &layers);
    for (int base = 0; base < uprights; base += THREADS) {
      if (!kept) {
        Upright shape;
        const int n = base + t;
        const int shown = n < uprights && upright(c, s, e, n, &shape) && shape.first < right && shape.last > left;
        __syncthreads(); /* nobody is at the list of the pass before */
        found = gather(&gathered, n, shown);
      }
      for (int k = 0; k < found; k += many) {
        if (!kept) many = set_up(&frame, gathered.list, k, found, left, &shapes);
        if (drawn)
          for (int word = 0; word < (many + 31) / 32; ++word)
            for (unsigned left_over = shapes.book.covering[word][across]; left_over; left_over &= left_over - 1) {
              const Place* at = &shapes.book.places[32 * word + __ffs((int)left_over) - 1];
              insert_side(c, shapes.numbers + at->begins + NUMBERS * (across - at->first), 1, row, &layers);
            }
      }
    }
    if (uprights == 0) __syncthreads(); /* waves and planes are there */
    kept = uprights <= THREADS && found <= many;
    if (drawn)
      batch.pictures[((int64_t)m * c->height + row) * c->width + column] =
          blend(c, s, frame.planes, e, waves, 0, 0, ahead, 0, dz, &layers);
  }
}

static __global__ void __launch_bounds__(THREADS, RESIDENT) measure(const Batch batch) {
  __shared__ Frame frame;
  __shared__ Gathered gathered;
  __shared__ Level levels[MEASURED_AT_ONCE];
  __shared__ unsigned covering[COLUMNS];
  __shared__ float from[MEASURED_AT_ONCE * COLUMNS], to[MEASURED_AT_ONCE * COLUMNS];
  const int t = threadIdx.x, strips = (batch.width + COLUMNS - 1) / COLUMNS;
  const uint32_t m = blockIdx.x / strips;
  const int left = (int)(blockIdx.x % strips) * COLUMNS;
  share_frame(&batch, m, &frame);
  const Camera* c = &frame.camera;
  const Shapes* s = &frame.shapes;
  const Eye* e = &frame.eye;
  const int uprights = s->boxes + s->cylinders, across = column_of(t), column = left + across;
  const int in_image = column < c->width;
  const float u = c->u[in_image ? column : c->width - 1], dx = e->cos + u * e->sin, dy = e->sin - u * e->cos;
  int found = 0, kept = 0;
  for (int first = 0; first < c->height; first += ROWS) {
    const int row = first + row_of(t), drawn = in_image && row < c->height;
    const float dz = c->v[row < c->height ? row : c->height - 1], per_z = inverses(dz);
    float nearest = nearest_of_others(s, frame.planes, e, dx, dy, dz);
    for (int base = 0; base < uprights; base += THREADS) {
      if (!kept) {
        const int n = base + t, shown = n < uprights && !upright_out_of_sight(c, s, e, n);
        __syncthreads(); /* nobody is at the list of the pass before */
        found = gather(&gathered, n, shown);
      }
      for (int k = 0; k < found; k += MEASURED_AT_ONCE) {
        const int many = found - k < MEASURED_AT_ONCE ? found - k : MEASURED_AT_ONCE;
        if (!kept) {
          __syncthreads();
          if (t < COLUMNS) covering[t] = 0;
          if (t < many) levels[t] = level_of(s, e, gathered.list[k + t]);
          __syncthreads();
          for (int task = t; task < many * COLUMNS; task += THREADS) {
            const int which = task / COLUMNS, n = gathered.list[k + which], x = task % COLUMNS, at = left + x;
            if (at >= c->width) continue;
            beside(s, e, n, turn_of(s, n), e->cos + c->u[at] * e->sin, e->sin - c->u[at] * e->cos, &from[task],
                   &to[task]);
            if (from[task] < to[task] && to[task] > 0) atomicOr(&covering[x], 1u << which);
          }
          __syncthreads();
        }
        for (unsigned left_over = covering[across]; left_over; left_over &= left_over - 1) {
          const int which = __ffs((int)left_over) - 1, at = which * COLUMNS + across;
          nearest = nearer_upright(levels[which], from[at], to[at], per_z, nearest);
        }
      }
    }
    kept = uprights <= THREADS && found <= MEASURED_AT_ONCE;
    if (drawn) batch.pictures[((int64_t)m * c->height + row) * c->width + column] = nearest;
  }
}

/* Lists the upright shapes from `base` on, at most one a thread, that a camera on the body may show between two
 * columns; returns how many they are. Every thread of the block calls it. */
FN int gather_tilted(const Frame* f, const Bounds* bounds, int base, int left, int right, Gathered* gathered) {
  Tilted shape;
  const int n = base + threadIdx.x;
  const int shown = n < f->shapes.boxes + f->shapes.cylinders &&
                    tilted_shape(&f->camera, &f->shapes, &f->eye, bounds, n, &shape) && shape.first < right &&
                    shape.last > left;
  __syncthreads(); /* nobody is at the list of the pass before */
  return gather(gathered, n, shown);
}

/* The upright shapes before a camera on the body. */
typedef struct {
  Book book;
  Tilted staged[STAGED];
  Seen shapes[KEPT];
  float heights[TILTED_ROOM];
} TiltedShapes;

/* As `set_up`. */
FN int set_up_tilted(const Frame* f, const Bounds* bounds, const int* list, int k, int found, int left,
                     TiltedShapes* to) {
  const Camera* c = &f->camera;
  const int t = threadIdx.x;
  int many = 0, used = 0, full = 0;
  clear_book(&to->book);
  while (!full && k + many < found) {
    const int staged = next_of(found - k - many, many);
    if (t < staged) tilted_shape(c, &f->shapes, &f->eye, bounds, list[k + many + t], &to->staged[t]);
    __syncthreads();
    int fit = 0;
    for (; fit < staged; ++fit) {
      const Tilted* p = &to->staged[fit];
      const int numbers = HEIGHTS(p->seen.is_box, c->across);
      if (!reserve(&to->book, many + fit, p->first, p->last, left, numbers, TILTED_ROOM, &used)) break;
      if (t == fit) to->shapes[many + fit] = p->seen;
    }
    __syncthreads();
    for (int task = t; task < fit * COLUMNS; task += THREADS) {
      const int which = many + task / COLUMNS, x = task % COLUMNS, at = x - to->book.places[which].first;
      if (at < 0 || at >= to->book.places[which].columns) continue;
      const Tilted* p = &to->staged[task / COLUMNS];
      float* of = to->heights + to->book.places[which].begins + HEIGHTS(p->seen.is_box, c->across) * at;
      write_heights(c, p, c->u[left + x], of, 1);
      if (of[0] < of[1]) atomicOr(&to->book.covering[which / 32][x], 1u << which % 32);
    }
    __syncthreads();
    many += fit, full = fit < staged || many == KEPT;
  }
  return many;
}

static __global__ void __launch_bounds__(THREADS, TILTED_RESIDENT) draw_tilted(const Batch batch) {
  __shared__ Frame frame;
  __shared__ Wave waves[MOST_WAVES];
  __shared__ Bounds bounds;
  __shared__ Gathered gathered;
  __shared__ TiltedShapes shapes;
  const int t = threadIdx.x, strips = (batch.width + COLUMNS - 1) / COLUMNS;
  const uint32_t m = blockIdx.x / strips;
  const int left = (int)(blockIdx.x % strips) * COLUMNS, right = left + COLUMNS;
  share_frame(&batch, m, &frame);
  const Camera* c = &frame.camera;
  const Shapes* s = &frame.shapes;
  const Eye* e = &frame.eye;
  if (t == THREADS - 1) waves_of(c, e, waves);
  if (t == THREADS - 33) light_planes(c, s, e, frame.planes);
  if (t == THREADS - 65) bounds_of(c, e, &bounds);
  __syncthreads();

  const int uprights = s->boxes + s->cylinders, across = column_of(t), column = left + across;
  const int in_image = column < c->width;
  const float u = c->u[in_image ? column : c->width - 1];
  float ahead[3];
  ray_ahead(e, u, ahead);
  int found = 0, many = 0, listed = 0, kept = 0; /* listed, kept: all that is shown is in the list, in shared memory */
  for (int first = 0; first < c->height; first += ROWS) {
    const int row = first + row_of(t), drawn = in_image && row < c->height;
    const float v = c->v[row < c->height ? row : c->height - 1];
    Layers layers;
    layers.inserted = 0;
    for (int base = 0; base < uprights; base += THREADS) {
      if (!listed) found = gather_tilted(&frame, &bounds, base, left, right, &gathered);
      for (int k = 0; k < found; k += many) {
        if (!kept) many = set_up_tilted(&frame, &bounds, gathered.list, k, found, left, &shapes);
        if (drawn)
          for (int word = 0; word < (many + 31) / 32; ++word)
            for (unsigned left_over = shapes.book.covering[word][across]; left_over; left_over &= left_over - 1) {
              const int which = 32 * word + __ffs((int)left_over) - 1;
              const Seen* p = &shapes.shapes[which];
              const Place* at = &shapes.book.places[which];
              const float* of = shapes.heights + at->begins + HEIGHTS(p->is_box, c->across) * (across - at->first);
              if (v >= of[0] && v <= of[1]) insert_rows(c, p, u, v, of, 1, &layers);
            }
      }
    }
    listed = uprights <= THREADS, kept = listed && found <= many;
    if (!drawn) continue;
    for (int n = 0; n < s->spheres; ++n) insert_sphere(c, s, e, n, ahead, v, &layers);
    batch.pictures[((int64_t)m * c->height + row) * c->width + column] =
        blend(c, s, frame.planes, e, waves, 0, 0, ahead, 0, v, &layers);
  }
}

static __global__ void __launch_bounds__(THREADS, TILTED_RESIDENT) measure_tilted(const Batch batch) {
  __shared__ Frame frame;
  __shared__ Bounds bounds;
  __shared__ Gathered gathered;
  __shared__ Level levels[THREADS];
  __shared__ Turn turns[THREADS];
  const int t = threadIdx.x, strips = (batch.width + COLUMNS - 1) / COLUMNS;
  const uint32_t m = blockIdx.x / strips;
  const int left = (int)(blockIdx.x % strips) * COLUMNS, right = left + COLUMNS;
  share_frame(&batch, m, &frame);
  const Camera* c = &frame.camera;
  const Shapes* s = &frame.shapes;
  const Eye* e = &frame.eye;
  if (t == 0) bounds_of(c, e, &bounds);
  __syncthreads();
  const int uprights = s->boxes + s->cylinders, column = left + column_of(t), in_image = column < c->width;
  float ahead[3];
  ray_ahead(e, c->u[in_image ? column : c->width - 1], ahead);
  int found = 0, listed = 0;
  for (int first = 0; first < c->height; first += ROWS) {
    const int row = first + row_of(t), drawn = in_image && row < c->height;
    const float v = c->v[row < c->height ? row : c->height - 1];
    const float dx = ahead[0] + e->up[0] * v, dy = ahead[1] + e->up[1] * v, dz = ahead[2] + e->up[2] * v;
    const float per_z = inverses(dz);
    float nearest = nearest_of_others(s, frame.planes, e, dx, dy, dz);
    for (int base = 0; base < uprights; base += THREADS) {
      if (!listed) {
        found = gather_tilted(&frame, &bounds, base, left, right, &gathered);
        if (t < found) levels[t] = level_of(s, e, gathered.list[t]), turns[t] = turn_of(s, gathered.list[t]);
        __syncthreads();
      }
      for (int k = 0; k < found; ++k) {
        float from, to;
        beside(s, e, gathered.list[k], turns[k], dx, dy, &from, &to);
        nearest = nearer_upright(levels[k], from, to, per_z, nearest);
      }
    }
    listed = uprights <= THREADS;
    if (drawn) batch.pictures[((int64_t)m * c->height + row) * c->width + column] = nearest;
  }
}

KERNEL_ON_CPU(draw)
KERNEL_ON_CPU(measure)
KERNEL_ON_CPU(draw_tilted)
KERNEL_ON_CPU(measure_tilted)

/* Launches a kernel on all frames of a call. */
#define DRAW(kernel, weighted)                                \
  if (asked_for_version(call)) return 0;                      \
  Batch batch;                                                \
  XLA_FFI_Error* error = batch_of(call, weighted, 0, &batch); \
  if (error || !batch.frames) return error;                   \
  RETURN_LAUNCHED(kernel, (int64_t)batch.frames*((batch.width + COLUMNS - 1) / COLUMNS), call, batch)

EXPORTED XLA_FFI_Error* edqn_pictures(XLA_FFI_CallFrame* call) { DRAW(draw, 1); }

EXPORTED XLA_FFI_Error* edqn_depths(XLA_FFI_CallFrame* call) { DRAW(measure, 0); }

EXPORTED XLA_FFI_Error* edqn_tilted_pictures(XLA_FFI_CallFrame* call) { DRAW(draw_tilted, 1); }

EXPORTED XLA_FFI_Error* edqn_tilted_depths(XLA_FFI_CallFrame* call) { DRAW(measure_tilted, 0); }

EXPORT_UNUSABLE(pictures)
