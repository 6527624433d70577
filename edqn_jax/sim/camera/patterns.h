/* Patterns of surfaces, each the average over LANES pixels of a column: `surfaces.py` in C, in its words. Constants in
 * capitals come from there and from `scene/surface.py`, through `constants.h`. `pictures.h` includes this.
 */

#ifndef EDQN_PATTERNS_H
#define EDQN_PATTERNS_H

/* By the number that KIND holds. */
enum { UNKNOWN = -1, BLANK, OF_WAVES, OF_NOISE, OF_CHECKS, OF_BRICKS, OF_POSTERS, OF_WOOD, OF_SPOTS };

/* What all pixels of a frame share of a phase of a surface. */
typedef struct {
  float k[3], at_eye;    /* cycles a metre; cycles at the eye */
  float right, up, axis; /* changes of k . ray over a pixel, and by `high` */
} Row;

typedef struct {
  int kind; /* UNKNOWN until it is asked for */
  float contrast, share[4];
  Row row[4];
} Pattern;

/* The rays of LANES pixels of a column, from `ahead` on by `high` along the image's axis, and where they meet. */
typedef struct {
  const float* ahead; /* [3] */
  Lanes high;
  Meeting at;
} Sight;

typedef struct {
  Lanes at, right, up;
} Phase;

/* The pattern of a surface whose shape is at `position`, from the eye at `origin`; right, up: of a ray over a pixel. */
FN Pattern pattern_of(const float* surface, const float* position, const float* origin, const float* right,
                      const float* up, const float* axis) {
  Pattern p;
  p.kind = (int)surface[KIND], p.contrast = surface[CONTRAST];
  if (p.kind == BLANK || p.contrast == 0) return p;
  const float x = origin[0] - position[0], y = origin[1] - position[1], z = origin[2] - position[2];
  UNROLLED for (int i = 0; i < 4; ++i) {
    const float *k = surface + PHASES + 4 * i, at = k[0] * x + k[1] * y + k[2] * z + k[3];
    const Row row = {{k[0], k[1], k[2]}, at - rintf(at), dot3(k, right), dot3(k, up), dot3(k, axis)};
    p.share[i] = surface[SHARES + i], p.row[i] = row;
  }
  return p;
}

FN Phase phase_of(const Sight* s, const Row* r) {
  const Lanes along = dot3(r->k, s->ahead) + r->axis * s->high;
  const Phase phase = {r->at_eye + s->at.depth * along, s->at.depth * r->right + s->at.right * along,
                       s->at.depth * r->up + s->at.up * along};
  return phase;
}

/* The phase a x p + b x q. */
FN Phase sum_of(float a, Phase p, float b, Phase q) {
  const Phase sum = {a * p.at + b * q.at, a * p.right + b * q.right, a * p.up + b * q.up};
  return sum;
}

FN Phase shifted(Phase p, float cycles) {
  p.at += cycles;
  return p;
}

FN Lanes fraction(Lanes phase) { return phase - nearest_whole(phase); }

FN Lanes wave(Lanes phase) {
  const Lanes f = fraction(phase);
  return f * (8.0f - 16.0f * absolute(f));
}

FN Lanes smooth(Phase p) { return box_filter(p.right) * box_filter(p.up) * wave(p.at); }

FN Lanes integral_of_pulses(Lanes at, float width) {
  const Lanes f = fraction(at);
  return between(f, -width / 2, width / 2) - width * f;
}

/* Pulses whose slopes are `edge` wide. */
FN Lanes soft_pulse(Phase p, float width, float edge) {
  const Lanes across = absolute(p.right), along = absolute(p.up);
  const Lanes longer = greater(across, along), shorter = lesser(across, along);
  const Lanes size = greater(greater(longer, 0.9f * longer + 0.47f * shorter), lanes(edge));
  const Lanes x = lesser(shorter * shorter, lanes(1)), at = fraction(p.at);
  const Lanes change = integral_of_pulses(at + size / 2, width) - integral_of_pulses(at - size / 2, width);
  return (1.0f - x * x) * change / size;
}

FN Lanes pulse(Phase p, float width) { return soft_pulse(p, width, EDGE); }

FN Phase warped(Phase p, Phase by, float amount) {
  const Lanes f = fraction(by.at), slope = amount * (8.0f - 32.0f * absolute(f));
  const Phase bent = {p.at + amount * wave(by.at), p.right + slope * by.right, p.up + slope * by.up};
  return bent;
}

FN Lanes waves(const Sight* s, const Pattern* p) {
  Lanes sum = lanes(0);
  for (int i = 0; i < 4; ++i)
    if (p->share[i] != 0) sum += p->share[i] * smooth(phase_of(s, &p->row[i]));
  return sum;
}

FN Lanes noise(const Sight* s, const Pattern* p) {
  const Phase a = phase_of(s, &p->row[0]), b = phase_of(s, &p->row[1]);
  const Phase c = phase_of(s, &p->row[2]), d = phase_of(s, &p->row[3]);
  const Lanes finer = p->share[0] * smooth(sum_of(1, c, 1, d)) + p->share[1] * smooth(sum_of(2, c, -1, b)) +
                      p->share[2] * smooth(sum_of(2, d, 1, a)) + p->share[3] * smooth(sum_of(3, c, -2, d));
  return p->share[0] * smooth(a) + p->share[1] * smooth(b) + p->share[2] * smooth(c) + p->share[3] * smooth(d) +
         OVERTONE * finer;
}

FN Lanes checks(const Sight* s, const Pattern* p) {
  const float width = p->share[3], per_height = 1 / most(width, 1 - width);
  const Lanes first = pulse(phase_of(s, &p->row[0]), width) * per_height;
  if (p->share[1] == 0 && p->share[2] == 0) return p->share[0] * first;
  const Lanes second = pulse(phase_of(s, &p->row[1]), width) * per_height;
  return p->share[0] * first + p->share[1] * (first * second) + p->share[2] * second;
}

FN Lanes bricks(const Sight* s, const Pattern* p) {
  const float of_level = p->share[1], of_upright = p->share[2];
  const Phase along = phase_of(s, &p->row[0]), courses = phase_of(s, &p->row[1]);
  const Lanes level = pulse(shifted(sum_of(2, courses, 0, courses), 0.5f), of_level) + of_level;
  const Lanes even = pulse(courses, 0.5f) + 0.5f, here = pulse(along, of_upright) + of_upright;
  const Lanes beside = pulse(shifted(along, 0.5f), of_upright) + of_upright;
  const Lanes upright = even * here + (1 - even) * beside;
  return p->share[0] * (level + upright - level * upright);
}

FN Lanes posters(const Sight* s, const Pattern* p) {
  const Phase c = phase_of(s, &p->row[2]), d = phase_of(s, &p->row[3]);
  const Lanes fine = smooth(c) + smooth(d) + smooth(sum_of(1, c, 1, d)) + smooth(sum_of(2, c, -1, d));
  const Lanes across = pulse(phase_of(s, &p->row[0]), p->share[2]) + p->share[2];
  const Lanes high = pulse(phase_of(s, &p->row[1]), p->share[3]) + p->share[3];
  return across * high * (p->share[0] + p->share[1] * fine);
}

FN Lanes wood(const Sight* s, const Pattern* p) {
  const float warp = p->share[1], width = p->share[2];
  const Phase bent = warped(warped(phase_of(s, &p->row[0]), phase_of(s, &p->row[1]), warp), phase_of(s, &p->row[2]),
                            0.5f * warp);
  return p->share[0] * pulse(bent, width) / most(width, 1 - width) + p->share[3] * smooth(phase_of(s, &p->row[3]));
}

FN Lanes spots(const Sight* s, const Pattern* p) {
  const float width = p->share[2], edge = p->share[3];
  const Lanes across = soft_pulse(phase_of(s, &p->row[0]), width, edge) + width;
  const Lanes here = across * (soft_pulse(phase_of(s, &p->row[1]), width, edge) + width);
  if (p->share[1] == 0) return p->share[0] * here;
  const Phase c = phase_of(s, &p->row[2]), d = phase_of(s, &p->row[3]);
  return here * (p->share[0] + p->share[1] * (smooth(c) + smooth(d) + smooth(sum_of(2, d, 1, c))));
}

/* The albedo of a surface relative to its own. */
FN Lanes relative_albedo(const Sight* s, const Pattern* p) {
  if (p->contrast == 0) return lanes(1);
  switch (p->kind) {
    case BLANK: return lanes(1);
    case OF_WAVES: return 1.0f + p->contrast * waves(s, p);
    case OF_NOISE: return 1.0f + p->contrast * noise(s, p);
    case OF_CHECKS: return 1.0f + p->contrast * checks(s, p);
    case OF_BRICKS: return 1.0f + p->contrast * bricks(s, p);
    case OF_POSTERS: return 1.0f + p->contrast * posters(s, p);
    case OF_WOOD: return 1.0f + p->contrast * wood(s, p);
    default: return 1.0f + p->contrast * spots(s, p);
  }
}

#endif
