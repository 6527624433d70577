/* What the sun does not reach, as in `shadows.py`: from the point that a layer shows a ray goes towards the sun. Fields
 * cast none here: JAX draws scenes with fields and shadows.
 *
 * Seen from the sun, every shape lies within a rectangle, and a ray towards the sun is a point: most shapes are ruled
 * out by that.
 */

#ifndef EDQN_SHADOWS_H
#define EDQN_SHADOWS_H

#define MARGIN_M 1e-3f /* of the rectangles: rounding of what is a hundred metres away */

/* The axes across the sun's rays: the first is level. */
typedef struct {
  float level[2], up[3];
} Across;

FN Across across_sun(const Camera* c) {
  const float* sun = c->sun;
  const float flat = sqrtf(sun[0] * sun[0] + sun[1] * sun[1]), per = inverse(flat);
  const float x = flat > 1e-6f ? -sun[1] * per : 1, y = flat > 1e-6f ? sun[0] * per : 0;
  const Across found = {{x, y}, {-sun[2] * y, sun[2] * x, sun[0] * y - sun[1] * x}};
  return found;
}

/* What casts a shadow, as the sun sees it: its middle and the halves of a rectangle around it; how a box is turned. */
typedef struct {
  float x, y, half_x, half_y;
  Turn turn;
} Caster;

/* Of shape `n`: boxes, cylinders, spheres. */
FN Caster caster_of(const Shapes* s, const Across* a, int n) {
  const int is_box = n < s->boxes, i = is_box ? n : n - s->boxes, is_round = i < s->cylinders;
  const float* at = is_box     ? s->box_position + 3 * i
                    : is_round ? s->cylinder_position + 3 * i
                               : s->sphere_position + 3 * (i - s->cylinders);
  const float flat = sqrtf(a->up[0] * a->up[0] + a->up[1] * a->up[1]);
  Caster found = {a->level[0] * at[0] + a->level[1] * at[1], dot3(a->up, at), 0, 0, {1, 0}};
  if (is_box) {
    const float *half = s->box_half + 3 * n, cos = cosf(s->box_yaw[n]), sin = sinf(s->box_yaw[n]);
    found.half_x = fabsf(a->level[0] * cos + a->level[1] * sin) * half[0] +
                   fabsf(a->level[1] * cos - a->level[0] * sin) * half[1];
    found.half_y = fabsf(a->up[0] * cos + a->up[1] * sin) * half[0] + fabsf(a->up[1] * cos - a->up[0] * sin) * half[1] +
                   fabsf(a->up[2]) * half[2];
    found.turn.cos = cos, found.turn.sin = sin;
  } else if (is_round) {
    found.half_x = s->cylinder_radius[i];
    found.half_y = flat * s->cylinder_radius[i] + fabsf(a->up[2]) * s->cylinder_half[i];
  } else {
    found.half_x = found.half_y = s->sphere_radius[i - s->cylinders];
  }
  found.half_x += MARGIN_M, found.half_y += MARGIN_M;
  return found;
}

/* The distance towards the sun at which LANES points of shapes of these numbers leave shape `n`, at which they enter it
 * if they are its own; less than 0 where they do not. */
FN Lanes meets(const Camera* c, const Shapes* s, const Caster* k, int n, Lanes shape, Lanes x, Lanes y, Lanes z) {
  const Mask itself = shape == (float)n;
  const float* sun = c->sun;
  if (n < s->boxes) {
    const float *at = s->box_position + 3 * n, *half = s->box_half + 3 * n, cos = k->turn.cos, sin = k->turn.sin;
    const Lanes dx = x - at[0], dy = y - at[1], dz = z - at[2];
    const float px = inverse(cos * sun[0] + sin * sun[1]), py = inverse(cos * sun[1] - sin * sun[0]);
    const float pz = inverse(sun[2]), rx = half[0] * fabsf(px), ry = half[1] * fabsf(py), rz = half[2] * fabsf(pz);
    const Lanes mx = (cos * dx + sin * dy) * -px, my = (cos * dy - sin * dx) * -py, mz = dz * -pz;
    const Lanes enter = greater(greater(mx - rx, my - ry), mz - rz), leave = lesser(lesser(mx + rx, my + ry), mz + rz);
    return pick(enter < leave, pick(itself, enter, leave), lanes(-1));
  }
  if (n < s->boxes + s->cylinders) {
    const int i = n - s->boxes;
    const float *at = s->cylinder_position + 3 * i, radius = s->cylinder_radius[i];
    const float flat = most(sun[0] * sun[0] + sun[1] * sun[1], TINY), pz = inverse(sun[2]);
    const float half = s->cylinder_half[i] * fabsf(pz);
    const Lanes dx = x - at[0], dy = y - at[1], middle = (dx * sun[0] + dy * sun[1]) * (-1 / flat);
    const Lanes qx = dx + middle * sun[0], qy = dy + middle * sun[1], inside = radius * radius - (qx * qx + qy * qy);
    const Lanes reach = roots(greater(inside, lanes(0)) * (1 / flat)), mz = (z - at[2]) * -pz;
    const Lanes enter = greater(middle - reach, mz - half), leave = lesser(middle + reach, mz + half);
    return pick((inside > 0) & (enter < leave), pick(itself, enter, leave), lanes(-1));
  }
  const int i = n - s->boxes - s->cylinders;
  const float *at = s->sphere_position + 3 * i, radius = s->sphere_radius[i], a = dot3(sun, sun);
  const Lanes dx = x - at[0], dy = y - at[1], dz = z - at[2];
  const Lanes middle = (dx * sun[0] + dy * sun[1] + dz * sun[2]) * (-1 / a);
  const Lanes qx = dx + middle * sun[0], qy = dy + middle * sun[1], qz = dz + middle * sun[2];
  const Lanes miss2 = qx * qx + qy * qy + qz * qz;
  const Lanes reach = roots(greater(radius * radius - miss2, lanes(0)) * (1 / a));
  return pick(roots(miss2) < radius, pick(itself, middle - reach, middle + reach), lanes(-1));
}

/* Whether the sun does not reach LANES points of shapes of these numbers. What casts shadows is computed here where
 * `casters` is null. */
FN Mask in_shadow(const Camera* c, const Shapes* s, const Caster* casters, Lanes shape, Lanes x, Lanes y, Lanes z) {
  const Across a = across_sun(c);
  const Lanes px = a.level[0] * x + a.level[1] * y, py = a.up[0] * x + a.up[1] * y + a.up[2] * z;
  Lanes dark = lanes(0);
  for (int n = 0; n < s->boxes + s->cylinders + s->spheres; ++n) {
    const Caster k = casters ? casters[n] : caster_of(s, &a, n);
    if (!any_of((absolute(px - k.x) < k.half_x) & (absolute(py - k.y) < k.half_y))) continue;
    dark = pick(meets(c, s, &k, n, shape, x, y, z) > CLEAR_M, lanes(1), dark);
  }
  for (int n = 0; n < s->planes; ++n) {
    const float *normal = s->plane_normal + 3 * n, *at = s->plane_position + 3 * n, approach = dot3(normal, c->sun);
    if (approach >= 0) continue;
    const Lanes height = (x - at[0]) * normal[0] + (y - at[1]) * normal[1] + (z - at[2]) * normal[2];
    const Lanes t = height * -inverse(approach);
    dark = pick((t > CLEAR_M) & (t < HORIZON_M), lanes(1), dark);
  }
  return dark > 0;
}

/* Brightness under the ambient light alone of the shapes of these numbers: boxes, cylinders, spheres, planes. */
FN Lanes ambient_of(const Camera* c, const Shapes* s, const Eye* e, Lanes shape) {
  const int counts[4] = {s->boxes, s->cylinders, s->spheres, s->planes};
  const float* albedos[4] = {s->box_albedo, s->cylinder_albedo, s->sphere_albedo, s->plane_albedo};
  Lanes found = lanes(0);
  for (float number = highest(shape); number >= 0; number = highest(shape)) {
    int kind = 0, n = (int)number;
    while (kind < 3 && n >= counts[kind]) n -= counts[kind++];
    const float ambient = c->ambient * dot3(albedos[kind] + 3 * n, e->weights);
    found = pick(shape == number, lanes(ambient), found), shape = pick(shape == number, lanes(-1), shape);
  }
  return found;
}

/* Of what LANES rays at heights `high` of a column meet at `depth`: `value`, or where the sun does not reach it the
 * brightness of `coverage` under the ambient light. */
FN Lanes shaded(const Camera* c, const Shapes* s, const Eye* e, const Caster* casters, const float* ahead, Lanes high,
                Lanes depth, Lanes shape, Lanes coverage, Lanes value) {
  const Lanes x = e->origin[0] + depth * (ahead[0] + e->up[0] * high);
  const Lanes y = e->origin[1] + depth * (ahead[1] + e->up[1] * high);
  const Lanes z = e->origin[2] + depth * (ahead[2] + e->up[2] * high);
  const Mask dark = in_shadow(c, s, casters, shape, x, y, z) & (shape >= 0);
  if (!any_of(dark)) return value;
  return pick(dark, coverage * ambient_of(c, s, e, pick(dark, shape, lanes(-1))), value);
}

#endif
