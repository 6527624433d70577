/* Upright shapes under a camera that is fixed to the body, where no side is a vertical line: coverage is counted over a
 * few rays a pixel, as `coverage.add_sampled_layers` does; `pictures.c` and `pictures.cu` include this.
 *
 * Faces of boxes are convex and flat: the rays of one column meet one in an interval of heights, and closeness is
 * linear in the image. So a column's intervals are computed once for all of its rows.
 */

#ifndef EDQN_TILTED_H
#define EDQN_TILTED_H

#define CUT_M 1e-3f /* nearest depth of what is projected */
#define MOST_CORNERS 8 /* of a rectangle that a plane cuts: 5, or twice 4 of numbers that are not finite */

/* A face of a box in the image, convex. */
typedef struct {
  int corners;
  float u[MOST_CORNERS], v[MOST_CORNERS];
} Face;

/* What is seen on a face: closeness at the image's middle, its changes; brightness. */
typedef struct {
  float at_zero, per_u, per_v, bright;
} Front;

/* What pixels need of a box or a cylinder. */
typedef struct {
  int is_box, number, faces;                    /* its number among all shapes; how many of its faces are seen */
  float origin[3], forward[3], right[3], up[3]; /* in its own frame: the eye from its middle; the image's axes */
  float radius, half_height, value, sun[2], end_bright; /* of a cylinder */
  Front front[3];                                       /* of a box, whose far faces the eye does not see */
} Seen;

/* A box or a cylinder, in its own frame. */
typedef struct {
  Seen seen;
  int first, last; /* columns that it may cover, the last excluded */
  float half[3];
  Turn turn;       /* of its axes */
  float bright[3]; /* of the faces that the eye may see */
  Face face[6];    /* of a cylinder those of the box around it, which faces the eye; all six from within */
} Tilted;

/* What LANES rays meet: whether, how close it is, and the brightness there. */
typedef struct {
  Mask hit;
  Lanes closeness, bright;
} Met;

/* Rays d meet a cylinder of radius r at closeness k where |o k + d| = r k, with the eye at o from its axis: solved
 * without a division by what differs between rays. Its end, where the eye is beyond it, lies in a plane. */
FN Met meet_cylinder(const Camera* c, const Seen* p, float u, Lanes v) {
  const float x = p->origin[0], z = p->origin[2], r2 = p->radius * p->radius, beyond = fabsf(z) - p->half_height;
  const Lanes dx = (p->forward[0] + u * p->right[0]) + v * p->up[0];
  const Lanes dy = (p->forward[1] + u * p->right[1]) + v * p->up[1];
  const Lanes dz = (p->forward[2] + u * p->right[2]) + v * p->up[2];
  Met met = {v != v, lanes(0), lanes(0)};
  if (x > p->radius) {
    const Lanes under = r2 * (dx * dx + dy * dy) - x * x * dy * dy;
    const Lanes k = (roots(greater(under, lanes(0))) - x * dx) * (1 / (x * x - r2));
    met.hit = (under > 0) & (k > 0) & (absolute(z * k + dz) <= p->half_height * k);
    if (any_of(met.hit)) {
      const Lanes lit = ((x * k + dx) * p->sun[0] + dy * p->sun[1]) / (p->radius * greater(k, lanes(TINY)));
      met.closeness = k, met.bright = p->value * (c->ambient + (1 - c->ambient) * greater(lit, lanes(0)));
    }
  }
  if (beyond > 0) {
    const Lanes k = dz / (z > 0 ? -beyond : beyond), px = x * k + dx;
    const Mask on_end = (k > 0) & (px * px + dy * dy <= r2 * k * k);
    met.hit |= on_end, met.closeness = pick(on_end, k, met.closeness);
    met.bright = pick(on_end, lanes(p->end_bright), met.bright);
  }
  return met;
}

/* Sets a face of a box from its axis and side: what of it is in front of the near plane; returns whether any is. */
FN int face_of(const Tilted* p, int axis, float side, Face* f) {
  const Seen* q = &p->seen;
  const int one = (axis + 1) % 3, other = (axis + 2) % 3;
  float at[4][3], ahead[4];
  for (int i = 0; i < 4; ++i) {
    at[i][axis] = side * p->half[axis] - q->origin[axis];
    at[i][one] = (i == 1 || i == 2 ? p->half[one] : -p->half[one]) - q->origin[one];
    at[i][other] = (i >= 2 ? p->half[other] : -p->half[other]) - q->origin[other];
    ahead[i] = dot3(at[i], q->forward);
  }
  f->corners = 0;
  for (int i = 0; i < 4; ++i) {
    const int j = (i + 1) & 3;
    if (ahead[i] >= CUT_M) {
      f->u[f->corners] = dot3(at[i], q->right) / ahead[i], f->v[f->corners++] = dot3(at[i], q->up) / ahead[i];
    }
    if ((ahead[i] >= CUT_M) != (ahead[j] >= CUT_M)) {
      const float share = (CUT_M - ahead[i]) / (ahead[j] - ahead[i]);
      float cut[3];
      for (int k = 0; k < 3; ++k) cut[k] = at[i][k] + share * (at[j][k] - at[i][k]);
      f->u[f->corners] = dot3(cut, q->right) / CUT_M, f->v[f->corners++] = dot3(cut, q->up) / CUT_M;
    }
  }
  return f->corners > 2;
}

/* Returns what is seen on a face of a box. */
FN Front front_of(const Tilted* p, int axis, float side) {
  const Seen* q = &p->seen;
  const float plane = inverse(side * p->half[axis] - q->origin[axis]);
  const Front front = {q->forward[axis] * plane, q->right[axis] * plane, q->up[axis] * plane, p->bright[axis]};
  return front;
}

/* Sets the faces that the eye may see and the columns that they cover; returns whether there are any. */
FN int faces_of(const Camera* c, Tilted* p) {
  Seen* q = &p->seen;
  float left = NOWHERE, right = -NOWHERE;
  int outside = 0;
  for (int k = 0; k < 3; ++k) outside |= fabsf(q->origin[k]) > p->half[k];
  if (!outside && q->is_box) return 0;
  q->faces = 0;
  for (int k = 0; k < 3; ++k)
    for (float side = -1; side < 2; side += 2) {
      Face* f = &p->face[q->faces];
      if (outside && !(side * q->origin[k] > p->half[k])) continue;
      if (!face_of(p, k, side, f)) continue;
      for (int i = 0; i < f->corners; ++i) left = least(left, f->u[i]), right = most(right, f->u[i]);
      if (q->is_box) q->front[q->faces] = front_of(p, k, side);
      ++q->faces;
    }
  columns_between(c, left, right, &p->first, &p->last);
  return q->faces && p->first < p->last;
}

/* The heights between which LANES columns at `u` are on a face; empty if the first is above the second. */
FN void heights_on(const Face* f, Lanes u, Lanes* low, Lanes* high) {
  *low = lanes(NOWHERE), *high = lanes(-NOWHERE);
  for (int i = 0; i < f->corners; ++i) {
    const int j = i + 1 < f->corners ? i + 1 : 0;
    const float from = least(f->u[i], f->u[j]), to = most(f->u[i], f->u[j]);
    const float slope = (f->v[j] - f->v[i]) * inverse(f->u[j] - f->u[i]);
    const Mask here = (u >= from) & (u < to);
    const Lanes v = f->v[i] + (u - f->u[i]) * slope;
    *low = pick(here & (v < *low), v, *low), *high = pick(here & (v > *high), v, *high);
  }
}

/* The planes that bound what can be in the image, with normals outwards; lengths of their horizontal parts. */
typedef struct {
  float normal[5][3], flat[5];
} Bounds;

FN void bounds_of(const Camera* c, const Eye* e, Bounds* b) {
  const float edge = 0.5f * c->pitch * c->width, top = 0.5f * c->pitch * c->height;
  for (int i = 0; i < 3; ++i) {
    b->normal[0][i] = -e->forward[i];
    b->normal[1][i] = e->right[i] - edge * e->forward[i], b->normal[2][i] = -e->right[i] - edge * e->forward[i];
    b->normal[3][i] = e->up[i] - top * e->forward[i], b->normal[4][i] = -e->up[i] - top * e->forward[i];
  }
  for (int k = 0; k < 5; ++k) b->flat[k] = sqrtf(b->normal[k][0] * b->normal[k][0] + b->normal[k][1] * b->normal[k][1]);
}

/* Whether no part of an upright cylinder, its middle `to` [3] from the eye, can be in the image. */
FN int out_of_bounds(const Bounds* b, const float* to, float radius, float half) {
  const float r = radius * 1.0001f + 1e-3f, h = half * 1.0001f + 1e-3f;
  int out = 0;
  for (int k = 0; k < 5; ++k) out |= dot3(b->normal[k], to) > r * b->flat[k] + h * fabsf(b->normal[k][2]);
  return out;
}

/* Sets brightness of a shape with these axes; depth images do without. */
FN void light_tilted(const Camera* c, const Shapes* s, const Eye* e, const float axes[3][3], Tilted* p) {
  Seen* q = &p->seen;
  memset(p->bright, 0, sizeof p->bright);
  if (!e->weights) return;
  const float* albedo = q->is_box ? s->box_albedo + 3 * q->number : s->cylinder_albedo + 3 * (q->number - s->boxes);
  q->value = dot3(albedo, e->weights);
  q->sun[0] = dot3(axes[0], c->sun), q->sun[1] = dot3(axes[1], c->sun);
  for (int k = 0; k < 3; ++k) {
    const float sign = q->origin[k] > 0 ? 1 : -1;
    p->bright[k] = q->value * shade(c, sign * axes[k][0], sign * axes[k][1], sign * axes[k][2]);
  }
  q->end_bright = p->bright[2];
}

/* Returns whether upright shape `n`, boxes first, may be seen, and what pixels need of it. */
FN INLINED int tilted_shape(const Camera* c, const Shapes* s, const Eye* e, const Bounds* bounds, int n, Tilted* p) {
  const int is_box = n < s->boxes, i = is_box ? n : n - s->boxes;
  const float* at = is_box ? s->box_position + 3 * i : s->cylinder_position + 3 * i;
  const float away[3] = {e->origin[0] - at[0], e->origin[1] - at[1], e->origin[2] - at[2]};
  const float to[3] = {-away[0], -away[1], -away[2]}, *half = s->box_half + 3 * i;
  const float radius = is_box ? sqrtf(half[0] * half[0] + half[1] * half[1]) : s->cylinder_radius[i];
  const float tall = is_box ? half[2] : s->cylinder_half[i];
  if (out_of_bounds(bounds, to, radius, tall)) return 0;
  const float flat = sqrtf(away[0] * away[0] + away[1] * away[1]);
  const int on_axis = flat < TINY; /* of a cylinder, whose frame faces the eye: then any does */
  const float cos = is_box ? cosf(s->box_yaw[i]) : on_axis ? 1 : away[0] / flat;
  const float sin = is_box ? sinf(s->box_yaw[i]) : on_axis ? 0 : away[1] / flat;
  const float axes[3][3] = {{cos, sin, 0}, {-sin, cos, 0}, {0, 0, 1}};
  Seen* q = &p->seen;
  q->is_box = is_box, q->number = n, q->radius = radius, q->half_height = tall;
  for (int k = 0; k < 3; ++k) {
    q->origin[k] = dot3(axes[k], away), q->forward[k] = dot3(axes[k], e->forward);
    q->right[k] = dot3(axes[k], e->right), q->up[k] = dot3(axes[k], e->up);
    p->half[k] = is_box ? half[k] : k < 2 ? radius : tall;
  }
  p->turn.cos = cos, p->turn.sin = sin;
  light_tilted(c, s, e, axes, p);
  return faces_of(c, p);
}

/* The heights between which LANES columns at `u` are on any face of a shape; empty if the first is above the second. */
FN void heights_of_shape(const Tilted* p, Lanes u, Lanes* low, Lanes* high) {
  *low = lanes(NOWHERE), *high = lanes(-NOWHERE);
  for (int f = 0; f < p->seen.faces; ++f) {
    Lanes from, to;
    heights_on(&p->face[f], u, &from, &to);
    *low = lesser(*low, from), *high = greater(*high, to);
  }
}

/* Lowers `nearest` of LANES rows at heights `v` of a column to the depth at which their middle rays meet a shape. */
FN Lanes nearer_tilted(const Shapes* s, const Eye* e, const Tilted* p, const float* ahead, Lanes v, Lanes nearest) {
  const Turn none = {1, 0}, turn = p->seen.is_box ? p->turn : none;
  const Lanes dx = ahead[0] + e->up[0] * v, dy = ahead[1] + e->up[1] * v, dz = ahead[2] + e->up[2] * v;
  Lanes from, to;
  beside(s, e, p->seen.number, turn, dx, dy, &from, &to);
  return nearer_upright(level_of(s, e, p->seen.number), from, to, inverses(dz), nearest);
}

#define HEIGHTS(is_box, across) (2 + ((is_box) ? 6 : 2) * (across)) /* arrays that `write_heights` writes at most */

/* Writes what LANES columns at `u` need of a shape, in arrays that are `stride` apart: the heights between which rows
 * may show it, then low and high of every ray across, of a box for each of its faces. */
FN void write_heights(const Camera* c, const Tilted* p, Lanes u, float* heights, int stride) {
  Lanes lowest = lanes(NOWHERE), highest = lanes(-NOWHERE), low, high;
  float* to = heights + 2 * stride;
  for (int f = 0; f < (p->seen.is_box ? p->seen.faces : 1); ++f)
    for (int a = 0; a < c->across; ++a, to += 2 * stride) {
      const Lanes at = u + c->pitch * ((a + 0.5f) / c->across - 0.5f);
      if (p->seen.is_box)
        heights_on(&p->face[f], at, &low, &high);
      else
        heights_of_shape(p, at, &low, &high);
      store(to, low), store(to + stride, high);
      lowest = lesser(lowest, low), highest = greater(highest, high);
    }
  store(heights, lowest - c->pitch), store(heights + stride, highest + c->pitch);
}

/* Adds what LANES rows at `high` of a column at `u` show of a box. */
FN void insert_box(const Camera* c, const Seen* p, float u, Lanes high, const float* heights, int stride,
                   Layers* layers) {
  Lanes count = lanes(0), closeness = lanes(0), value = lanes(0);
  for (int n = 0; n < p->faces; ++n) {
    const Front* f = &p->front[n];
    Lanes on_face = lanes(0);
    for (int a = 0; a < c->across; ++a, heights += 2 * stride) {
      const float low = heights[0], top = heights[stride];
      if (low > top) continue;
      const float shift = c->pitch * ((a + 0.5f) / c->across - 0.5f), ahead = f->at_zero + (u + shift) * f->per_u;
      for (int d = 0; d < c->down; ++d) {
        const Lanes v = high + c->pitch * ((d + 0.5f) / c->down - 0.5f);
        const Mask hit = (v >= low) & (v < top);
        on_face += pick(hit, lanes(1), lanes(0)), closeness += pick(hit, ahead + v * f->per_v, lanes(0));
      }
    }
    count += on_face, value += f->bright * on_face;
  }
  if (!any_of(count > 0)) return;
  const float per_ray = 1.0f / (c->across * c->down);
  const Layer added = {closeness / greater(count, lanes(TINY)), count * per_ray, value * per_ray, lanes(0),
                       lanes((float)p->number)};
  insert(layers, added);
}

/* The same of a cylinder. */
FN void insert_cylinder(const Camera* c, const Seen* p, float u, Lanes high, const float* heights, int stride,
                        Layers* layers) {
  Lanes count = lanes(0), closeness = lanes(0), value = lanes(0);
  for (int a = 0; a < c->across; ++a) {
    const float low = heights[2 * a * stride], top = heights[(2 * a + 1) * stride];
    if (low > top || !any_of((high + c->pitch > low) & (high - c->pitch < top))) continue;
    for (int d = 0; d < c->down; ++d) {
      const Met met = meet_cylinder(c, p, u + c->pitch * ((a + 0.5f) / c->across - 0.5f),
                                    high + c->pitch * ((d + 0.5f) / c->down - 0.5f));
      count += pick(met.hit, lanes(1), lanes(0)), value += pick(met.hit, met.bright, lanes(0));
      closeness += pick(met.hit, met.closeness, lanes(0));
    }
  }
  if (!any_of(count > 0)) return;
  const float per_ray = 1.0f / (c->across * c->down);
  const Layer added = {closeness / greater(count, lanes(TINY)), count * per_ray, value * per_ray, lanes(0),
                       lanes((float)p->number)};
  insert(layers, added);
}

/* The part of the image, a pixel and a half wider, in which a sphere may be seen, if the eye's axes have length 1. */
FN Extent extent_of_sphere(const Camera* c, const Shapes* s, const Eye* e, int n) {
  const float *at = s->sphere_position + 3 * n, r = s->sphere_radius[n], margin = 1.5f * c->pitch;
  const float to[3] = {at[0] - e->origin[0], at[1] - e->origin[1], at[2] - e->origin[2]};
  const float ahead = dot3(to, e->forward), right = dot3(to, e->right), up = dot3(to, e->up);
  const float near = ahead - r, far = ahead + r;
  Extent found = {-FAR_U, FAR_U, -FAR_U, FAR_U, 0, 0, 0};
  if (near > NEAR_M) {
    found.left = (right - r) / (right > r ? far : near) - margin;
    found.right = (right + r) / (right > -r ? near : far) + margin;
    found.bottom = (up - r) / (up > r ? far : near) - margin, found.top = (up + r) / (up > -r ? near : far) + margin;
  }
  if (far < 0) found.left = NOWHERE;
  return found;
}

/* Adds what LANES rows at `high` of a column at `u` show of a shape, which `write_heights` wrote `heights` of. */
FN void insert_rows(const Camera* c, const Seen* p, float u, Lanes high, const float* heights, int stride,
                    Layers* layers) {
  if (p->is_box)
    insert_box(c, p, u, high, heights + 2 * stride, stride, layers);
  else
    insert_cylinder(c, p, u, high, heights + 2 * stride, stride, layers);
}

/* Adds a shape to the layers of the rows of a column at `u`, of heights `v` and in blocks of LANES. */
FN void insert_tilted(const Camera* c, const Seen* p, float u, const float* v, const float* heights, int stride,
                      Layers* layers) {
  for (int first = 0; first < c->height; first += LANES, ++layers) {
    const int last = first + LANES < c->height ? first + LANES - 1 : c->height - 1;
    if (v[first] < heights[0] || v[last] > heights[stride]) continue;
    insert_rows(c, p, u, load(v + first), heights, stride, layers);
  }
}

#endif
