/* Where rays meet fields, in C for CPUs and in CUDA: `field_batch.h` and the camera's `fields.h` include this, `field.py`
 * has the same in JAX.
 *
 * Neighbouring rays advance together as far as none of them can meet anything. Then each goes from cell to cell: out of
 * the one where it is, and on by the distance there. Where the distance at either end is small, the ray ends between
 * them, where it is `STOPS` of a cell and `CONE` of its depth. So where it ends does not depend on where it began.
 */

#ifndef EDQN_FIELD_RAYS_H
#define EDQN_FIELD_RAYS_H

#include "wide.h"

#define TINY 1e-9f                /* kind.py; the others are of field_rays.py: tests/sim/scene/test_field_rays.py holds
                                     them equal */
#define STEPS 256
#define STOPS 0.002f
#define CONE 0.00002f
#define BLOCK 4
#define WORTH 0.2f
#define FINER_STEPS 4
#define FINER_WORTH 0.1f
#define FINER_ROOM 0.2f
#define REFINED 3
#define PER_CELL 1000.0f
#define FAR_M 1e30f
#define ROUNDED 1.2e-7f

#if WIDE == 1
#define TOGETHER 1
#define AT_ONCE 1
#else
#define TOGETHER 16
#define AT_ONCE 2 /* vectors of rays, which do not wait for each other */
#endif
#define CHUNK (TOGETHER * WIDE) /* rays whose groups fill a vector */

typedef struct {
  const int16_t* values; /* in thousandths of a cell */
  const float* least;    /* metres, in each block of BLOCK cells along each axis */
  int across, along;     /* values from one place to the next along x and y */
  int blocks_across, blocks_along;
  float last[3]; /* number of the last value along each axis */
  float most[3]; /* where a ray is taken to be at most: in the last cell, also where so large a number is rounded */
  float cell, per_cell;
} Lattice;

/* A field and the eye, in the field's own axes. */
typedef struct {
  const float* turn;        /* [3, 3] body-to-world */
  float eye[3], half[3];    /* metres */
  float from[3];            /* the eye in cells */
} View;

/* Rays side by side, of lengths in cells. */
typedef struct {
  Wide d[3], per_d[3], ahead[3]; /* ahead: 1 where it grows along an axis, else 0 */
  Wide leave, per_value;         /* per_value: depths of a thousandth of a cell */
} Ray;

/* A cell: its corners, where in it a ray is, and the depth at which that leaves it. */
typedef struct {
  Wide corner[8], part[3], rest;
} Cell;

FN Wide one_over(Wide x) { return 1.0f / choose(size_of(x) < TINY, wide(TINY), x); }

FN Lattice lattice_of(const int16_t* values, const float* least, const int32_t* counts, float cell) {
  const int y = (counts[1] + BLOCK - 2) / BLOCK, z = (counts[2] + BLOCK - 2) / BLOCK;
  Lattice g = {values, least, counts[1] * counts[2], counts[2], y * z, z, {0}, {0}, cell, 1.0f / cell};
  for (int i = 0; i < 3; ++i) g.last[i] = (float)(counts[i] - 1), g.most[i] = g.last[i] * (1 - ROUNDED) - 0.001f;
  return g;
}

FN View view_of(const Lattice* g, const float* position, const float* turn, const float* half, const float* origin) {
  View v;
  const float away[3] = {origin[0] - position[0], origin[1] - position[1], origin[2] - position[2]};
  v.turn = turn;
  for (int i = 0; i < 3; ++i) {
    v.eye[i] = turn[i] * away[0] + turn[3 + i] * away[1] + turn[6 + i] * away[2], v.half[i] = half[i];
    v.from[i] = v.eye[i] * g->per_cell + 0.5f * g->last[i];
  }
  return v;
}

/* Where rays are at a depth, in cells from the first value along axis `i`. */
FN Wide along_axis(const Lattice* g, const View* v, int i, Wide d, Wide depth) {
  return smaller(larger(v->from[i] + depth * d, wide(0)), wide(g->most[i]));
}

/* The least distances in the blocks where rays are. */
FN Wide least_around(const Lattice* g, const View* v, const Wide d[3], Wide depth) {
  const Whole x = floored(along_axis(g, v, 0, d[0], depth)) / BLOCK;
  const Whole y = floored(along_axis(g, v, 1, d[1], depth)) / BLOCK;
  const Whole z = floored(along_axis(g, v, 2, d[2], depth)) / BLOCK;
  return gathered(g->least, x * g->blocks_across + y * g->blocks_along + z);
}

FN Cell cell_around(const Lattice* g, const View* v, const Ray* r, Wide depth) {
  const int stride[3] = {g->across, g->along, 1};
  Cell c;
  Whole at = whole(0);
  Wide rest = wide(FAR_M);
  for (int i = 0; i < 3; ++i) {
    const Wide x = along_axis(g, v, i, r->d[i], depth);
    const Whole lower = floored(x);
    c.part[i] = x - as_wide(lower), at += lower * stride[i];
    rest = smaller(rest, (r->ahead[i] - c.part[i]) * r->per_d[i]);
  }
  c.rest = larger(rest, wide(0));
  gathered_pair(g->values, at, &c.corner[0], &c.corner[1]);
  gathered_pair(g->values, at + g->along, &c.corner[2], &c.corner[3]);
  gathered_pair(g->values, at + g->across, &c.corner[4], &c.corner[5]);
  gathered_pair(g->values, at + (g->across + g->along), &c.corner[6], &c.corner[7]);
  return c;
}

FN Wide mixed(Wide low, Wide high, Wide part) { return low + part * (high - low); }

/* The distance in a cell, `further` than where the ray is, in thousandths of a cell. */
FN Wide distance_in(const Cell* c, const Ray* r, Wide further) {
  const Wide *k = c->corner, x = c->part[0] + further * r->d[0], y = c->part[1] + further * r->d[1];
  const Wide z = c->part[2] + further * r->d[2];
  const Wide y0 = mixed(mixed(k[0], k[1], z), mixed(k[2], k[3], z), y);
  const Wide y1 = mixed(mixed(k[4], k[5], z), mixed(k[6], k[7], z), y);
  return mixed(y0, y1, x);
}

/* The same, and its slopes per cell. */
FN Wide slopes_in(const Cell* c, const Ray* r, Wide further, Wide slope[3]) {
  const Wide *k = c->corner, x = c->part[0] + further * r->d[0], y = c->part[1] + further * r->d[1];
  const Wide z = c->part[2] + further * r->d[2];
  const Wide z00 = mixed(k[0], k[1], z), z01 = mixed(k[2], k[3], z);
  const Wide z10 = mixed(k[4], k[5], z), z11 = mixed(k[6], k[7], z);
  const Wide y0 = mixed(z00, z01, y), y1 = mixed(z10, z11, y);
  slope[0] = y1 - y0, slope[1] = mixed(z01 - z00, z11 - z10, x);
  slope[2] = mixed(mixed(k[1] - k[0], k[3] - k[2], y), mixed(k[5] - k[4], k[7] - k[6], y), x);
  return mixed(y0, y1, x);
}

/* The distance at which a ray ends, in thousandths of a cell. */
FN Wide end_at(const Lattice* g, Wide depth) { return PER_CELL * STOPS + PER_CELL * CONE * g->per_cell * depth; }

/* Rays of a chunk: metres in the field's own axes, and the depths at which they enter and leave the box around it. */
typedef struct {
  float d[3][CHUNK], enter[CHUNK], leave[CHUNK];
  float middle[3][WIDE], spread[WIDE], first[WIDE], last[WIDE]; /* of groups */
} Chunk;

/* Reads `count` rays; what is beyond repeats the last. Returns whether any of them enters the box. */
FN int read_rays(const View* v, const float* const rays[3], int64_t count, Chunk* c) {
  const float* t = v->turn;
  Whole entered = whole(0);
  for (int b = 0; b < CHUNK; b += WIDE) {
    Wide ray[3], enter = wide(0), leave = wide(FAR_M);
    for (int i = 0; i < 3; ++i) {
      float edge[WIDE];
      if (b + WIDE > count)
        for (int l = 0; l < WIDE; ++l) edge[l] = rays[i][b + l < count ? b + l : count - 1];
      ray[i] = wide_at(b + WIDE > count ? edge : rays[i] + b);
    }
    for (int i = 0; i < 3; ++i) {
      const Wide d = t[i] * ray[0] + t[3 + i] * ray[1] + t[6 + i] * ray[2], per = one_over(d);
      const Wide middle = -v->eye[i] * per, reach = v->half[i] * size_of(per);
      keep(c->d[i] + b, d), enter = larger(enter, middle - reach), leave = smaller(leave, middle + reach);
    }
    keep(c->enter + b, enter), keep(c->leave + b, leave), entered |= enter < leave;
  }
  return any(entered);
}

/* Sets what groups of TOGETHER rays share: a direction, how far others are from it, where they enter and leave. */
FN void group_rays(Chunk* c) {
  for (int n = 0; n < WIDE; ++n) {
    float low[3], high[3], first = FAR_M, last = 0.0f;
    for (int i = 0; i < 3; ++i) {
      const float* d = c->d[i] + n * TOGETHER;
      low[i] = high[i] = d[0];
      for (int k = 0; k < TOGETHER; ++k) low[i] = d[k] < low[i] ? d[k] : low[i], high[i] = d[k] > high[i] ? d[k] : high[i];
      c->middle[i][n] = 0.5f * (low[i] + high[i]), high[i] = 0.5f * (high[i] - low[i]);
    }
    const float *enter = c->enter + n * TOGETHER, *leave = c->leave + n * TOGETHER;
    for (int k = 0; k < TOGETHER; ++k) {
      first = enter[k] < first ? enter[k] : first, last = leave[k] > last ? leave[k] : last;
    }
    c->spread[n] = sqrtf(high[0] * high[0] + high[1] * high[1] + high[2] * high[2]);
    c->first[n] = first, c->last[n] = last;
  }
}

/* The depths up to which groups of rays meet nothing. */
FN Wide march_together(const Lattice* g, const View* v, const Chunk* c) {
  const Wide spread = wide_at(c->spread), last = wide_at(c->last);
  Wide d[3] = {wide_at(c->middle[0]), wide_at(c->middle[1]), wide_at(c->middle[2])}, depth = wide_at(c->first);
  const Wide per_metre = 1.0f / (root(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) + spread);
  for (int i = 0; i < 3; ++i) d[i] *= g->per_cell;
  Whole going = depth < last;
  for (int step = 0; step < STEPS && any(going); ++step) {
    const Wide room = least_around(g, v, d, depth) - spread * depth;
    going &= (room >= WORTH * spread * depth + g->cell) & (depth < last);
    depth += choose(going, room * per_metre, wide(0));
  }
#if TOGETHER > 1
  const Ray r = {{d[0], d[1], d[2]}, {wide(0), wide(0), wide(0)}, {wide(0), wide(0), wide(0)}, last, wide(0)};
  going = depth < last;
  for (int step = 0; step < FINER_STEPS && any(going); ++step) {
    const Cell here = cell_around(g, v, &r, depth);
    const Wide room = distance_in(&here, &r, wide(0)) * (g->cell / PER_CELL) - spread * depth;
    going &= (room >= FINER_WORTH * spread * depth + FINER_ROOM * g->cell) & (depth < last);
    depth += choose(going, room * per_metre, wide(0));
  }
#endif
  return depth;
}

/* A vector of rays on its way. */
typedef struct {
  Ray ray;
  Wide depth, stride; /* stride: what the last step went on by the distance at the end of a cell */
  Whole going;
  int number, steps;
} Walk;

FN Walk walk_from(const Lattice* g, const Chunk* c, const float* start, int number) {
  const int b = number * WIDE;
  const Wide d[3] = {wide_at(c->d[0] + b), wide_at(c->d[1] + b), wide_at(c->d[2] + b)};
  const Wide enter = wide_at(c->enter + b), per_cell = wide(g->per_cell);
  Walk w;
  for (int i = 0; i < 3; ++i) {
    w.ray.d[i] = d[i] * per_cell, w.ray.per_d[i] = one_over(d[i]) * g->cell;
    w.ray.ahead[i] = choose(d[i] > -TINY, wide(1), wide(0));
  }
  w.ray.leave = wide_at(c->leave + b);
  w.ray.per_value = (g->cell / PER_CELL) / root(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
#if TOGETHER % WIDE == 0
  w.depth = larger(wide(start[b / TOGETHER]), enter);
#else
  float each[WIDE];
  for (int l = 0; l < WIDE; ++l) each[l] = start[(b + l) / TOGETHER];
  w.depth = larger(wide_at(each), enter);
#endif
  w.going = (enter < w.ray.leave) & (w.depth < w.ray.leave), w.number = number, w.steps = 0;
  w.stride = wide(0);
  return w;
}

/* Takes a step; returns whether any of the rays goes on. */
FN int step_on(const Lattice* g, const View* v, Walk* w) {
  const Cell c = cell_around(g, v, &w->ray, w->depth);
  const Wide here = distance_in(&c, &w->ray, wide(0)), there = distance_in(&c, &w->ray, c.rest);
  w->going &= (here > end_at(g, w->depth)) & (there > end_at(g, w->depth + c.rest));
  w->stride = choose(w->going, there * w->ray.per_value, w->stride);
  w->depth += choose(w->going, c.rest + w->stride, wide(0));
  w->going &= w->depth < w->ray.leave;
  return any(w->going) && ++w->steps < STEPS;
}

/* Sets where rays end in their last cell: depths, FAR_M where nothing is met, and normals in the world. */
FN void end_walk(const Lattice* g, const View* v, const Walk* w, Wide* depth, Wide normal[3]) {
  const Ray* r = &w->ray;
  const Cell c = cell_around(g, v, r, w->depth);
  const Wide here = distance_in(&c, r, wide(0)) - end_at(g, w->depth);
  const Wide there = distance_in(&c, r, c.rest) - end_at(g, w->depth + c.rest);
  const Whole within = (here > 0.0f) & (there <= 0.0f), beyond = here <= 0.0f; /* the last step was too long */
  Wide further = choose(within, c.rest * here / choose(within, here - there, wide(1)), wide(0)), slope[3];
  for (int k = 0; k < REFINED; ++k) {
    const Wide left = slopes_in(&c, r, further, slope) - end_at(g, w->depth + further);
    const Wide fall = slope[0] * r->d[0] + slope[1] * r->d[1] + slope[2] * r->d[2] - PER_CELL * CONE * g->per_cell;
    if (k + 1 < REFINED) {
      const Wide next = further - left / smaller(fall, wide(-TINY));
      further = choose(within, smaller(larger(next, wide(0)), c.rest), further);
      further = choose(beyond & (fall < 0.0f), smaller(larger(next, -w->stride), wide(0)), further);
    }
  }
  const Wide end = w->depth + further, *s = slope;
  const Whole hit = (end > 0.0f) & (end < r->leave);
  const float* t = v->turn;
  const Wide scale = choose(hit, one_over(root(s[0] * s[0] + s[1] * s[1] + s[2] * s[2])), wide(0));
  *depth = choose(hit, end, wide(FAR_M));
  for (int i = 0; i < 3; ++i) normal[i] = scale * (t[3 * i] * s[0] + t[3 * i + 1] * s[1] + t[3 * i + 2] * s[2]);
}

/* Writes where a vector of rays ended, of which `count` are left. */
FN void write_ends(const Lattice* g, const View* v, const Walk* w, int64_t count, float* depth, float* const normal[3]) {
  Wide end, along[3];
  const int b = w->number * WIDE;
  end_walk(g, v, w, &end, along);
  if (b + WIDE <= count) {
    keep(depth + b, end);
    for (int i = 0; i < 3; ++i) keep(normal[i] + b, along[i]);
    return;
  }
  float each[4][WIDE];
  keep(each[0], end), keep(each[1], along[0]), keep(each[2], along[1]), keep(each[3], along[2]);
  for (int l = 0; b + l < count; ++l) {
    depth[b + l] = each[0][l];
    for (int i = 0; i < 3; ++i) normal[i][b + l] = each[1 + i][l];
  }
}

/* Writes where `count` rays meet a field: depths [count], FAR_M where nothing is met, and three parts of normals. Returns
 * whether any enters the box around it. */
FN int trace(const Lattice* g, const View* v, const float* const rays[3], int64_t count, float* depth,
             float* const normal[3]) {
  int entered = 0;
  for (int64_t begin = 0; begin < count; begin += CHUNK) {
    const float* const from[3] = {rays[0] + begin, rays[1] + begin, rays[2] + begin};
    float* const to[3] = {normal[0] + begin, normal[1] + begin, normal[2] + begin};
    const int64_t left = count - begin < CHUNK ? count - begin : CHUNK;
    const int vectors = (int)((left + WIDE - 1) / WIDE);
    Chunk c;
    float start[WIDE];
    Walk walk[AT_ONCE];
    int next = 0, walking = 0;
    if (!read_rays(v, from, left, &c)) {
      for (int64_t k = 0; k < left; ++k) depth[begin + k] = FAR_M, to[0][k] = to[1][k] = to[2][k] = 0.0f;
      continue;
    }
    entered = 1;
    group_rays(&c);
    keep(start, march_together(g, v, &c));
    while (walking < AT_ONCE && next < vectors) walk[walking++] = walk_from(g, &c, start, next++);
    while (walking)
      for (int n = 0; n < walking; ++n) {
        if (step_on(g, v, &walk[n])) continue;
        write_ends(g, v, &walk[n], left, depth + begin, to);
        if (next < vectors)
          walk[n] = walk_from(g, &c, start, next++);
        else
          walk[n--] = walk[--walking];
      }
  }
  return entered;
}

#endif
