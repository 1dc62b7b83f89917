/* The fastest timing of one path by a backward and a forward pass over intervals of constant u''.

   docs/explanation/timing.md explains the method; `symbolic.limits.limit_layout` the coefficients
   at a sample.
   The text before this file defines INTERVALS, JOINTS, the SIZE of a sample's row, the offset of
   every block (AT_...), RATIOS, CUTS, the lines per sample that a caller adds, HELD, the input with
   the payload's parameters, the enumerations of the limits and of their slack groups (`LIMITS` of
   `symbolic.limits`), limit_forces, limit_force_slopes, limit_ratios, limit_slopes of CasADi, and
   the largest size of their work arrays and of the solved variables (ROOM_...).

   x and y are the squared speeds u'^2 at the beginning and the end of an interval. There is rest at
   both ends of the path, and standing still is allowed everywhere, so that (0, 0) satisfies every
   row that is made here. */

enum { REACHED, AT_REST, STUCK, SLOWED, BROKEN };

#define SAMPLES (2 * INTERVALS + 1)  /* of the path: the ends of the intervals and their middles */
#define HALF (0.5 * INTERVALS)       /* u'' = HALF (y - x) */
#define MAX_ROWS 160
#define MAX_ROUNDS 40             /* of rows added at one interval */
#define MAX_RENEWALS 6            /* of linearisations at one interval */
#define MAX_SWEEPS 12
#define MAX_HALVINGS 60
#define MAX_REPAIRS (100 * INTERVALS)
#define CONVEX_TOLERANCE 1e-7     /* excess over a limit that counts as none */
#define RATIO_TOLERANCE 1e-4      /* the same, of limits that are linearised */
#define CONFLICT 1e-3             /* excess at which an interval counts as impossible */
#define TIGHTEN 1e-3              /* excess between the ends of an interval that tightens it */
#define LARGEST_EXCESS 5e-3       /* a timing with more is slowed down */
#define LEAST_SPEED 0.98          /* slowed further, it has not converged */
#define NEARLY 0.9                /* a limit used this far is worth a row in advance */

typedef struct { double x, y, bound; int key; } line; /* x X + y Y <= bound */

/* The largest use of a kind of limit: over the limit, where, and of which joint or contact. */
typedef struct { double ratio, parameter; int column; } largest_use;

/* Both normal forces, and what was solved for them, from which ratios and slopes follow. */
typedef struct { double n[2], solved[ROOM_SOLVED]; } held_load;

/* What was found at an interval, after the numbers it was asked for; later sweeps change few. */
typedef struct {
  double back[4];       /* ceiling, top and guess of `backward`, and its answer */
  double ahead[3];      /* x and top of `forward`, and its answer */
  double at[2][2];      /* x and y of `loads` and of `ratios` */
  held_load loads[2];   /* at both ends */
  double ratios[2][RATIOS];
  double judged[2];     /* x and y of what is judged inside */
  double peak[2];
  largest_use inside[KINDS];
} answers;

typedef struct {
  const double* samples;           /* (SAMPLES, SIZE) */
  double force;                    /* largest normal force, infinite without */
  int torque, pressure, reference; /* whether these limits hold */
  double* rest;                    /* (INTERVALS + 1, RATIOS) standing still */
  double* rest_force;              /* (INTERVALS + 1,) larger normal force standing still */
  double (*tight)[GROUPS];         /* (INTERVALS, GROUPS) divisor of what is left for motion */
  double* top;                     /* (INTERVALS + 1,) largest u'^2 that can be brought to rest */
  double* squared;                 /* (INTERVALS + 1,) u'^2 */
  answers* known;                  /* (INTERVALS,) */
  const double* held;              /* numbers of what is held */
  const double* cuts;              /* (SAMPLES, CUTS, 3) alpha u'' + beta u'^2 <= bound, infinite
                                      from the last one on */
} problem;

static double larger(double a, double b) { return a > b ? a : b; }
static double smaller(double a, double b) { return a < b ? a : b; }

/* ---- quantities at a sample ---- */

typedef int casadi_function(const double**, double**, long long*, double*, int);

/* One of CasADi's functions of a sample, u'' and u'^2, and its results, unused ones null. */
static void ask(casadi_function* function, const problem* p, const double* f, double a, double w,
                const double* solved, double* first, double* second, double* third) {
  const double* arg[ROOM_ARG] = {f + AT_FORCE, &a, &w, p->held, solved};
  double *res[ROOM_RES] = {first, second, third}, room[ROOM_W];
  long long iw[ROOM_IW];
  function(arg, res, iw, room, 0);
}

static void load_at(const problem* p, const double* f, double a, double w, held_load* load) {
  ask(limit_forces, p, f, a, w, 0, load->n, load->solved, 0);
}

static void ratios_at(const problem* p, const double* f, double a, double w, const held_load* load,
                      double* ratios) {
  ask(limit_ratios, p, f, a, w, load->solved, ratios, 0, 0);
}

static void slopes_at(const problem* p, const double* f, double a, double w, const held_load* load,
                      double* r, double* by_a, double* by_w) {
  ask(limit_slopes, p, f, a, w, load->solved, r, by_a, by_w);
}

/* The larger normal force and its slopes by u'' and u'^2. */
static double force_slopes(const problem* p, const double* f, double a, double w,
                           const held_load* load, double* by_a, double* by_w) {
  double n[2], each_by_a[2], each_by_w[2];
  ask(limit_force_slopes, p, f, a, w, load->solved, n, each_by_a, each_by_w);
  const int k = n[1] > n[0];
  *by_a = each_by_a[k];
  *by_w = each_by_w[k];
  return n[k];
}

/* Whether an answer is known for other numbers than `asked`, which take their place then. */
static int differ(double* known, const double* asked, int count) {
  int found = 0;
  for (int k = 0; k < count; ++k) {
    found = found || known[k] != asked[k];
    known[k] = asked[k];
  }
  return found;
}

/* The loads of two samples, and their ratios (2, RATIOS). */
#if IN_PAIRS
typedef int pair_function(const lanes_real**, lanes_real**, lanes_int*, lanes_real*);

static void ask_both(pair_function* function, const problem* p, const double* const f[2],
                     int inputs, double a, const double w[2], const lanes_real* solved,
                     lanes_real* first, lanes_real* second) {
  lanes_real given[SIZE], as = {a, a}, ws = {w[0], w[1]};
  lanes_real room[limit_forces_in_pairs_W + limit_ratios_in_pairs_W + 1];
  const lanes_real* arg[limit_ratios_in_pairs_ARG] = {given, &as, &ws, (const lanes_real*)p->held,
                                                      solved};
  lanes_real* res[limit_forces_in_pairs_RES] = {first, second};
  lanes_int iw[1];
  for (int k = 0; k < inputs; ++k) given[k] = (lanes_real){f[0][AT_FORCE + k], f[1][AT_FORCE + k]};
  function(arg, res, iw, room);
}

static void both_loads(const problem* p, const double* const f[2], double a, const double w[2],
                       held_load* loads) {
  lanes_real n[2], solved[ROOM_SOLVED] = {{0}};
  ask_both(limit_forces_in_pairs, p, f, AT_TORQUE - AT_FORCE, a, w, 0, n, solved);
  for (int lane = 0; lane < 2; ++lane) {
    for (int k = 0; k < 2; ++k) loads[lane].n[k] = n[k][lane];
    for (int k = 0; k < ROOM_SOLVED; ++k) loads[lane].solved[k] = solved[k][lane];
  }
}

static void both_ratios(const problem* p, const double* const f[2], double a, const double w[2],
                        const held_load* loads, double (*ratios)[RATIOS]) {
  lanes_real found[RATIOS], solved[ROOM_SOLVED];
  for (int k = 0; k < ROOM_SOLVED; ++k)
    solved[k] = (lanes_real){loads[0].solved[k], loads[1].solved[k]};
  ask_both(limit_ratios_in_pairs, p, f, SIZE - AT_FORCE, a, w, solved, found, 0);
  for (int lane = 0; lane < 2; ++lane)
    for (int k = 0; k < RATIOS; ++k) ratios[lane][k] = found[k][lane];
}
#else
static void both_loads(const problem* p, const double* const f[2], double a, const double w[2],
                       held_load* loads) {
  for (int k = 0; k < 2; ++k) load_at(p, f[k], a, w[k], loads + k);
}

static void both_ratios(const problem* p, const double* const f[2], double a, const double w[2],
                        const held_load* loads, double (*ratios)[RATIOS]) {
  for (int k = 0; k < 2; ++k) ratios_at(p, f[k], a, w[k], loads + k, ratios[k]);
}
#endif

/* The loads at both ends of an interval, and what limits as ratios. */
static held_load* end_loads(const problem* p, int interval, double x, double y) {
  answers* known = p->known + interval;
  const double asked[2] = {x, y}, *f = p->samples + 2 * interval * SIZE;
  const double* const ends[2] = {f, f + 2 * SIZE};
  if (differ(known->at[0], asked, 2)) both_loads(p, ends, HALF * (y - x), asked, known->loads);
  return known->loads;
}

static double (*end_ratios(const problem* p, int interval, double x, double y))[RATIOS] {
  answers* known = p->known + interval;
  const double asked[2] = {x, y}, *f = p->samples + 2 * interval * SIZE;
  const double* const ends[2] = {f, f + 2 * SIZE};
  const held_load* loads = end_loads(p, interval, x, y);
  if (differ(known->at[1], asked, 2))
    both_ratios(p, ends, HALF * (y - x), asked, loads, known->ratios);
  return known->ratios;
}

/* ---- rows of an interval ---- */

/* alpha u'' + beta u'^2 <= bound at a share of an interval. */
static line inner_row(double alpha, double beta, double bound, double share) {
  const line row = {(1.0 - share) * beta - HALF * alpha, share * beta + HALF * alpha, bound, 0};
  return row;
}

/* The same at the beginning (end = 0) or the end of an interval. */
static line interval_row(double alpha, double beta, double bound, int end) {
  return inner_row(alpha, beta, bound, end);
}

static int append(line* rows, int count, line row) {
  if (count < MAX_ROWS) rows[count++] = row;
  return count;
}

/* Of the lines given at both ends and in the middle of an interval those that (x, y) uses furthest,
   where that is beyond `threshold`. */
static int given_rows(const problem* p, int interval, double x, double y, double threshold,
                      line* rows, int count) {
  for (int k = 0; k < 3; ++k) {
    const double share = 0.5 * k, a = HALF * (y - x), w = x + share * (y - x);
    const double *cut = p->cuts + 3 * CUTS * (2 * interval + k), *worst = 0;
    double largest = threshold;
    for (int j = 0; j < CUTS && isfinite(cut[2]); ++j, cut += 3) {
      const double use = (cut[0] * a + cut[1] * w) / cut[2];
      if (use > largest) { largest = use; worst = cut; }
    }
    if (worst) count = append(rows, count, inner_row(worst[0], worst[1], worst[2], share));
  }
  return count;
}

/* The convex limits of an interval that (x, y) uses beyond `threshold`, as supporting lines. */
static int convex_rows(const problem* p, int interval, double x, double y, double threshold,
                       line* rows, int count) {
  const double a = HALF * (y - x), limit = 1.0 / p->tight[interval][MOTION];
  for (int end = 0; end < 2; ++end) {
    const double* f = p->samples + 2 * (interval + end) * SIZE;
    const double w = end ? y : x;
    const double *alpha = f + AT_ACCELERATION, *beta = alpha + JOINTS;
    int worst = 0;
    double largest = -1.0;
    for (int j = 0; j < JOINTS; ++j) {
      const double value = fabs(alpha[j] * a + beta[j] * w);
      if (value > largest) { largest = value; worst = j; }
    }
    if (largest > limit * threshold) {
      const double sign = alpha[worst] * a + beta[worst] * w > 0.0 ? 1.0 : -1.0;
      const double by_a = sign * alpha[worst], by_w = sign * beta[worst];
      count = append(rows, count, interval_row(by_a, by_w, limit, end));
    }
    for (int cone = 0; cone < 2; ++cone) {
      const double *first = f + AT_CONE + 6 * cone, *second = first + 3;
      double v[3], length = 0.0, by_a = 0.0, by_w = 0.0;
      for (int k = 0; k < 3; ++k) {
        v[k] = first[k] * a + second[k] * w;
        length += v[k] * v[k];
      }
      length = sqrt(length);
      if (length <= limit * threshold || length <= 0.0) continue;
      for (int k = 0; k < 3; ++k) {
        by_a += v[k] / length * first[k];
        by_w += v[k] / length * second[k];
      }
      count = append(rows, count, interval_row(by_a, by_w, limit, end));
    }
    if (isfinite(p->force)) {
      const held_load* load = end_loads(p, interval, x, y) + end;
      double by_a, by_w;
      const double rest = p->rest_force[interval + end];
      const double bound = rest + (p->force - rest) / p->tight[interval][FORCE];
      if (larger(load->n[0], load->n[1]) - rest <= (bound - rest) * threshold) continue;
      const double value = force_slopes(p, f, a, w, load, &by_a, &by_w);
      const double still = value - by_a * a - by_w * w;
      const line row = interval_row(by_a / bound, by_w / bound, 1.0 - still / bound, end);
      count = append(rows, count, row);
    }
  }
  return given_rows(p, interval, x, y, threshold, rows, count);
}

static int limited(const problem* p, int ratio) {
  return ratio < JOINTS ? p->torque : p->pressure;
}

/* The limits that are not convex and that (x, y) exceeds, linearised there, each with its key;
   those of the keys in `wanted` (2 RATIOS) as well, where it is given. Rest stays allowed: a
   linearisation from far away must not forbid it. Returns their number; *worst is the largest
   excess. */
static int linearised_rows(const problem* p, int interval, double x, double y, const char* wanted,
                           line* rows, double* worst) {
  const double a = HALF * (y - x), tight = p->tight[interval][RATIO];
  int count = 0;
  *worst = -1.0;
  if (!p->torque && !p->pressure) return 0;
  for (int end = 0; end < 2; ++end) {
    const double* f = p->samples + 2 * (interval + end) * SIZE;
    const double w = end ? y : x;
    const double* known = end_ratios(p, interval, x, y)[end];
    double r[RATIOS], by_a[RATIOS], by_w[RATIOS];
    int exceeded = 0;
    for (int k = 0; k < RATIOS; ++k) {
      if (!limited(p, k)) continue;
      const double still = fabs(p->rest[(interval + end) * RATIOS + k]);
      const double bound = still + (1.0 - still) / tight;
      const double excess = fabs(known[k]) - bound;
      *worst = larger(*worst, excess);
      exceeded = exceeded || excess > RATIO_TOLERANCE || (wanted && wanted[end * RATIOS + k]);
    }
    if (!exceeded) continue;
    slopes_at(p, f, a, w, end_loads(p, interval, x, y) + end, r, by_a, by_w);
    for (int k = 0; k < RATIOS; ++k) {
      if (!limited(p, k)) continue;
      const double still = p->rest[(interval + end) * RATIOS + k];
      const double bound = fabs(still) + (1.0 - fabs(still)) / tight;
      if (fabs(r[k]) - bound <= RATIO_TOLERANCE && !(wanted && wanted[end * RATIOS + k])) continue;
      const double sign = r[k] > 0.0 ? 1.0 : -1.0;
      const double room = bound - sign * r[k] + sign * (by_a[k] * a + by_w[k] * w);
      const double least = 0.5 * (1.0 - sign * still);
      if (room >= least || w <= 0.0)
        rows[count] = interval_row(sign * by_a[k], sign * by_w[k], larger(room, least), end);
      else /* by u'^2 the chord to rest: a row that is only loosened may cut nothing off here */
        rows[count] = interval_row(sign * by_a[k], sign * (r[k] - still - by_a[k] * a) / w,
                                bound - sign * still, end);
      rows[count++].key = end * RATIOS + k;
    }
  }
  return count;
}

/* ---- linear programs in two variables: the largest x ---- */

/* Moves an optimum that `r` cuts off onto its line, within n rows and m more. */
static void move_onto(double* best, line r, const line* rows, int n, const line* more, int m) {
  const double size = r.x * r.x + r.y * r.y;
  if (size <= 0.0) return;
  const double px = r.x * r.bound / size, py = r.y * r.bound / size;
  const double tx = r.y, ty = -r.x;
  double low = -INFINITY, high = INFINITY;
  for (int k = 0; k < n + m; ++k) {
    const line* o = k < n ? rows + k : more + (k - n);
    const double along = o->x * tx + o->y * ty, room = o->bound - o->x * px - o->y * py;
    if (fabs(along) <= 1e-14 * (fabs(o->x * tx) + fabs(o->y * ty))) continue;
    const double place = room / along;
    if (along > 0.0) { if (place < high) high = place; }
    else if (place > low) low = place;
  }
  double place;
  if (low > high) place = 0.5 * (low + high);
  else if (tx > 0.0) place = high;
  else if (tx < 0.0) place = low;
  else place = smaller(larger(((best[0] - px) * tx + (best[1] - py) * ty) / size, low), high);
  best[0] = px + place * tx;
  best[1] = py + place * ty;
}

static int cuts(const double* best, line r) {
  const double x = r.x * best[0], y = r.y * best[1];
  return x + y > r.bound + 1e-13 * (fabs(x) + fabs(y));
}

/* ---- passes ---- */

/* Whether an interval's exact limits allow (x, y), up to an excess. */
static int allowed(const problem* p, int interval, double x, double y, double excess) {
  line scratch[MAX_ROWS];
  double worst;
  if (convex_rows(p, interval, x, y, 1.0 + excess, scratch, 0)) return 0;
  linearised_rows(p, interval, x, y, 0, scratch, &worst);
  return worst <= excess;
}

/* The largest u'^2 at the beginning of an interval from which at most `top` is left at its end. */
static double backward(const problem* p, int interval, double ceiling, double top, double guess) {
  line rows[MAX_ROWS] = {{1, 0, ceiling, 0}, {-1, 0, 0, 0}, {0, 1, top, 0}, {0, -1, 0, 0}};
  line near[2 * RATIOS], fresh[2 * RATIOS];
  double best[2] = {ceiling, smaller(top, ceiling)}, worst = -1.0, x = 0.0, y = 0.0, found = -1.0;
  int n_near = 0, from = 4, renewals = 0;
  int count = convex_rows(p, interval, smaller(guess, ceiling), top, NEARLY, rows, 4);
  for (int round = 0; round < MAX_ROUNDS; ++round) {
    for (; from < count; ++from)
      if (cuts(best, rows[from])) move_onto(best, rows[from], rows, from, 0, 0);
    double trial[2] = {best[0], best[1]};
    for (int k = 0; k < n_near; ++k)
      if (cuts(trial, near[k])) move_onto(trial, near[k], rows, count, near, k);
    x = smaller(larger(trial[0], 0.0), ceiling);
    y = smaller(larger(trial[1], 0.0), top);
    count = convex_rows(p, interval, x, y, 1.0 + CONVEX_TOLERANCE, rows, count);
    if (count > from) continue;
    int n_fresh = linearised_rows(p, interval, x, y, 0, fresh, &worst);
    if (worst <= RATIO_TOLERANCE) {
      /* Linearisations from elsewhere may cut off too much: renew here those that stop x. */
      char stops[2 * RATIOS] = {0};
      int any = 0;
      for (int k = 0; k < n_near; ++k)
        if (near[k].x * x + near[k].y * y > near[k].bound - RATIO_TOLERANCE)
          any = stops[near[k].key] = 1;
      const int better = x > found * (1.0 + RATIO_TOLERANCE);
      found = larger(found, x);
      if (!any || !better || ++renewals > MAX_RENEWALS) return found;
      n_fresh = linearised_rows(p, interval, x, y, stops, fresh, &worst);
    }
    for (int k = 0; k < n_fresh; ++k) { /* one linearisation per limit: the last */
      int place = 0;
      while (place < n_near && near[place].key != fresh[k].key) ++place;
      near[place] = fresh[k];
      if (place == n_near) ++n_near;
    }
  }
  if (found >= 0.0) return found;
  double low = 0.0, high = 1.0;
  for (int k = 0; k < 20; ++k) {
    const double share = 0.5 * (low + high);
    if (allowed(p, interval, share * x, share * y, CONFLICT)) low = share; else high = share;
  }
  return low * x;
}

/* Between an allowed u'^2 at the end of an interval and one beyond it: a linearisation may have
   left the limit far behind. */
static double halve(const problem* p, int interval, double x, double low, double high) {
  /* Counted: between 0 and the least number there is no middle that would end the loop. */
  for (int k = 0; k < MAX_HALVINGS && high - low > 1e-4 * high; ++k) {
    const double middle = 0.5 * (low + high);
    if (allowed(p, interval, x, middle, RATIO_TOLERANCE)) low = middle; else high = middle;
  }
  return low;
}

/* The largest u'^2 at the end of an interval that begins with x, at most `top`; negative where the
   interval's limits leave none. */
static double forward(const problem* p, int interval, double x, double top) {
  const double limit = 1.0 / p->tight[interval][MOTION];
  double high = top;
  for (int end = 0; end < 2; ++end) {
    const double* alpha = p->samples + 2 * (interval + end) * SIZE + AT_ACCELERATION;
    for (int j = 0; j < JOINTS; ++j) {
      const line r = interval_row(alpha[j], alpha[JOINTS + j], 0.0, end);
      if (fabs(r.y) <= 1e-300) continue;
      high = smaller(high, limit / fabs(r.y) - r.x * x / r.y);
    }
  }
  double y = high, beyond = high;
  for (int round = 0; round < MAX_ROUNDS; ++round) {
    line rows[MAX_ROWS];
    double worst = -1.0, next = y;
    int count = convex_rows(p, interval, x, y, 1.0 + CONVEX_TOLERANCE, rows, 0);
    if (!count) {
      count = linearised_rows(p, interval, x, y, 0, rows, &worst);
      if (count) beyond = y;
      else if (worst < -CONFLICT) y = halve(p, interval, x, y, beyond);
    }
    if (!count && y > 0.0) return y;
    if (!count) break;
    for (int k = 0; k < count; ++k)
      if (rows[k].y > 0.0) next = smaller(next, (rows[k].bound - rows[k].x * x) / rows[k].y);
    if (next >= y) break;
    y = next;
    if (y <= 0.0) break;
  }
  if (interval < INTERVALS - 1 && y <= 0.0) return -1.0;
  y = larger(y, 0.0);
  return allowed(p, interval, x, y, CONFLICT) ? y : -1.0;
}

/* Largest u'^2 that the speed limits leave at a grid point. */
static double speed_ceiling(const problem* p, int i) {
  const double* d = p->samples + 2 * i * SIZE + AT_SPEED;
  const int count = JOINTS + (p->reference ? 4 : 2);
  double demand = 1e-4, tight = 1.0;
  for (int k = 0; k < count; ++k) demand = larger(demand, fabs(d[k]));
  if (i > 0) tight = larger(tight, p->tight[i - 1][MOTION]);
  if (i < INTERVALS) tight = larger(tight, p->tight[i][MOTION]);
  return 1.0 / (tight * demand * demand);
}

/* Both passes; the interval that could not be driven, or -1. */
static int sweep(problem* p) {
  p->top[INTERVALS] = 0.0;
  for (int i = INTERVALS - 1; i >= 0; --i) {
    const double next = p->top[i + 1];
    const double guess = i < INTERVALS - 1 ? larger(2.0 * next - p->top[i + 2], next) : next;
    const double asked[3] = {speed_ceiling(p, i), next, guess};
    double* back = p->known[i].back;
    if (differ(back, asked, 3)) back[3] = backward(p, i, asked[0], next, guess);
    p->top[i] = back[3];
  }
  p->squared[0] = 0.0;
  int repairs = 0;
  for (int i = 0; i < INTERVALS;) {
    const double asked[2] = {p->squared[i], p->top[i + 1]};
    double* ahead = p->known[i].ahead;
    if (differ(ahead, asked, 2)) ahead[2] = forward(p, i, asked[0], asked[1]);
    if (ahead[2] >= 0.0) { p->squared[++i] = ahead[2]; continue; }
    /* Only limits that are not convex allow x and nothing after it: keep below this x. */
    if (i == 0 || ++repairs > MAX_REPAIRS) return i;
    p->top[i] = 0.998 * p->squared[i];
    --i;
  }
  return -1;
}

/* ---- the judgement of a timing ---- */

/* Cubic interpolation of the first `count` numbers of the samples' rows, at a place counted in
   samples. */
static void between(const problem* p, double place, int count, double* f) {
  int first = (int)place - 1;
  if (first < 0) first = 0;
  if (first > SAMPLES - 4) first = SAMPLES - 4;
  const double t = place - first;
  const double c[4] = {
    (t - 1) * (t - 2) * (t - 3) / -6, t * (t - 2) * (t - 3) / 2,
    t * (t - 1) * (t - 3) / -2, t * (t - 1) * (t - 2) / 6,
  };
  const double* s = p->samples + first * SIZE;
  for (int k = 0; k < count; ++k)
    f[k] = c[0] * s[k] + c[1] * s[SIZE + k] + c[2] * s[2 * SIZE + k] + c[3] * s[3 * SIZE + k];
}

static void note(largest_use* use, int kind, double ratio, double parameter, int column) {
  if (ratio <= use[kind].ratio) return;
  use[kind].ratio = ratio;
  use[kind].parameter = parameter;
  use[kind].column = column;
}

/* Every limited quantity over its limit at one sample, u = parameter, noted in `use`, from normal
   forces n and ratios, where these are given; `peak` keeps the largest normal forces. */
static void judge(const problem* p, const double* f, double parameter, double a, double w,
                  const double* n, const double* ratios, largest_use* use, double* peak) {
  const double speed = sqrt(larger(w, 0.0));
  const double *d = f + AT_SPEED, *alpha = f + AT_ACCELERATION, *cones = f + AT_CONE;
  for (int j = 0; j < JOINTS; ++j) {
    note(use, JOINT_SPEED, fabs(d[j]) * speed, parameter, j);
    note(use, JOINT_ACCELERATION, fabs(alpha[j] * a + alpha[JOINTS + j] * w), parameter, j);
  }
  note(use, BOX_SPEED, fabs(d[JOINTS]) * speed, parameter, 0);
  note(use, BOX_TURN, fabs(d[JOINTS + 1]) * speed, parameter, 0);
  if (p->reference)
    note(use, PATH_SPEED, larger(fabs(d[JOINTS + 2]), fabs(d[JOINTS + 3])) * speed, parameter, 0);
  for (int cone = 0; cone < 2; ++cone) {
    const double *first = cones + 6 * cone, *second = first + 3;
    double sum = 0.0;
    for (int k = 0; k < 3; ++k) {
      const double v = first[k] * a + second[k] * w;
      sum += v * v;
    }
    note(use, BOX_ACCELERATION + cone, sqrt(sum), parameter, 0);
  }
  for (int k = 0; k < 2; ++k) {
    peak[k] = larger(peak[k], n[k]);
    note(use, NORMAL_FORCE, n[k] / p->force, parameter, k);
  }
  if (!ratios) return;
  for (int k = 0; k < RATIOS; ++k) {
    if (!limited(p, k)) continue;
    if (k < JOINTS) note(use, JOINT_TORQUE, fabs(ratios[k]), parameter, k);
    else note(use, PRESSURE, fabs(ratios[k]), parameter, k - JOINTS);
  }
}

static double worst_of(const largest_use* use) {
  double largest = use[0].ratio;
  for (int k = 1; k < KINDS; ++k) largest = larger(largest, use[k].ratio);
  return largest;
}

static void reset(largest_use* use, double* peak) {
  for (int k = 0; k < KINDS; ++k) use[k].ratio = use[k].parameter = use[k].column = 0;
  peak[0] = peak[1] = 0.0;
}

/* Judges a timing slowed by `factor` inside an interval, at its middle and its quarters. What is
   between the samples is interpolated; ratios matter there only if the middle is near the limit. */
static void judge_inside(const problem* p, int interval, double factor, largest_use* use,
                         double* peak) {
  const double x = factor * factor * p->squared[interval];
  const double y = factor * factor * p->squared[interval + 1], a = HALF * (y - x);
  const double *sample = p->samples + (2 * interval + 1) * SIZE, half = 0.5 * (x + y);
  const int limits_ratios = p->torque || p->pressure;
  double f[2][SIZE], ratios[2][RATIOS];
  held_load loads[2];
  largest_use middle[KINDS] = {{0}};
  load_at(p, sample, a, half, loads);
  if (limits_ratios) ratios_at(p, sample, a, half, loads, ratios[0]);
  judge(p, sample, (interval + 0.5) / INTERVALS, a, half, loads[0].n, limits_ratios ? ratios[0] : 0,
        middle, peak);
  for (int k = 0; k < KINDS; ++k)
    note(use, k, middle[k].ratio, middle[k].parameter, middle[k].column);
  const int near = larger(middle[JOINT_TORQUE].ratio, middle[PRESSURE].ratio) > NEARLY;
  const double *quarters[2] = {f[0], f[1]}, shares[2] = {0.25, 0.75};
  const double w[2] = {x + 0.25 * (y - x), x + 0.75 * (y - x)};
  for (int k = 0; k < 2; ++k)
    between(p, 2.0 * (interval + shares[k]), near ? SIZE : AT_TORQUE, f[k]);
  both_loads(p, quarters, a, w, loads);
  if (near) both_ratios(p, quarters, a, w, loads, ratios);
  for (int k = 0; k < 2; ++k)
    judge(p, f[k], (interval + shares[k]) / INTERVALS, a, w[k], loads[k].n, near ? ratios[k] : 0,
          use, peak);
}

/* Judges a timing slowed by `factor` at the ends of all intervals and inside them; returns the
   largest use. */
static double judge_all(const problem* p, double factor, largest_use* use, double* peak) {
  reset(use, peak);
  for (int i = 0; i < INTERVALS; ++i) {
    const double x = factor * factor * p->squared[i], y = factor * factor * p->squared[i + 1];
    const held_load* loads = end_loads(p, i, x, y);
    const double(*ratios)[RATIOS] = p->torque || p->pressure ? end_ratios(p, i, x, y) : 0;
    for (int end = 0; end < 2; ++end)
      judge(p, p->samples + 2 * (i + end) * SIZE, (i + end) / (double)INTERVALS, HALF * (y - x),
            end ? y : x, loads[end].n, ratios ? ratios[end] : 0, use, peak);
    if (factor < 1.0) { judge_inside(p, i, factor, use, peak); continue; }
    const answers* known = p->known + i; /* by `tighten` */
    for (int k = 0; k < 2; ++k) peak[k] = larger(peak[k], known->peak[k]);
    for (int k = 0; k < KINDS; ++k)
      note(use, k, known->inside[k].ratio, known->inside[k].parameter, known->inside[k].column);
  }
  return worst_of(use);
}

/* Judges inside all intervals, where no limit was imposed, and tightens those that exceed one by
   the group of that limit; returns the largest use. */
static double tighten(problem* p) {
  double largest = 0.0;
  for (int i = 0; i < INTERVALS; ++i) {
    const double asked[2] = {p->squared[i], p->squared[i + 1]};
    answers* known = p->known + i;
    const largest_use* use = known->inside;
    double excess[GROUPS] = {1.0, 1.0, 1.0};
    if (differ(known->judged, asked, 2)) {
      reset(known->inside, known->peak);
      judge_inside(p, i, 1.0, known->inside, known->peak);
    }
    const double most = worst_of(use);
    largest = larger(largest, most);
    if (most > 1.0 + TIGHTEN) known->back[0] = known->ahead[0] = -1.0; /* for a wider limit */
    for (int k = 0; k < KINDS; ++k)
      if (use[k].ratio > 1.0 + TIGHTEN)
        excess[GROUP[k]] = larger(excess[GROUP[k]], use[k].ratio);
    const double rest = larger(p->rest_force[i], p->rest_force[i + 1]);
    if (excess[FORCE] > 1.0) excess[FORCE] = (excess[FORCE] * p->force - rest) / (p->force - rest);
    for (int k = 0; k < GROUPS; ++k) p->tight[i][k] *= excess[k];
  }
  return largest;
}

/* Standing still everywhere: fills `rest` and `rest_force`; returns the largest use. */
static double judge_rest(problem* p, largest_use* use, double* peak) {
  reset(use, peak);
  for (int i = 0; i <= INTERVALS; ++i) {
    const double* f = p->samples + 2 * i * SIZE;
    double* ratios = p->rest + i * RATIOS;
    held_load load;
    load_at(p, f, 0.0, 0.0, &load);
    ratios_at(p, f, 0.0, 0.0, &load, ratios);
    judge(p, f, i / (double)INTERVALS, 0.0, 0.0, load.n, p->torque || p->pressure ? ratios : 0,
          use, peak);
    p->rest_force[i] = larger(load.n[0], load.n[1]);
  }
  return worst_of(use);
}

/* Both passes until the limits hold between the ends of the intervals as well. */
static int solve(problem* p, largest_use* use, double* peak, double* interval, double* sweeps,
                 double* slowed) {
  for (int k = 0; k < SAMPLES * SIZE; ++k)
    if (!isfinite(p->samples[k])) {
      *interval = k / SIZE / 2;
      return BROKEN;
    }
  for (int i = 0; i < INTERVALS; ++i) {
    for (int k = 0; k < GROUPS; ++k) p->tight[i][k] = 1.0;
    p->known[i].back[0] = p->known[i].ahead[0] = p->known[i].judged[0] = -1.0;
    p->known[i].at[0][0] = p->known[i].at[1][0] = -1.0;
  }
  if (judge_rest(p, use, peak) >= 1.0 - 1e-6) return AT_REST;
  double worst = INFINITY;
  while (*sweeps < MAX_SWEEPS && worst > 1.0 + TIGHTEN) {
    const int stuck = sweep(p);
    *sweeps += 1.0;
    if (stuck >= 0) {
      *interval = stuck;
      return STUCK;
    }
    worst = tighten(p);
  }
  if (judge_all(p, 1.0, use, peak) <= 1.0 + LARGEST_EXCESS) return REACHED;
  double low = 0.0, high = 1.0;
  for (int k = 0; k < 14; ++k) {
    const double factor = 0.5 * (low + high);
    if (judge_all(p, factor, use, peak) > 1.0) high = factor; else low = factor;
  }
  judge_all(p, low, use, peak);
  for (int i = 0; i <= INTERVALS; ++i) p->squared[i] *= low * low;
  *slowed = low;
  return low < LEAST_SPEED ? SLOWED : REACHED;
}

/* Inputs: samples (SAMPLES, SIZE); options (4,): largest normal force, whether torques, pressure
   and the reference speeds are limited; with CUTS, cuts (SAMPLES, CUTS, 3). Outputs: status; interval of a failure; duration; peak (2,)
   normal forces; use (KINDS, 3): ratio, parameter, column; squared (INTERVALS + 1,) u'^2; sweeps;
   slowed. */
int path_timing(const double** arg, double** res, long long* iw, double* w, int mem) {
  const double* options = arg[1];
  double *status = res[0], *interval = res[1], *duration = res[2], *peak = res[3], *uses = res[4];
  double *squared = res[5], *sweeps = res[6], *slowed = res[7];
  largest_use use[KINDS];
  problem p = {
    arg[0], options[0], options[1] > 0.5, options[2] > 0.5, options[3] > 0.5, w,
    w + (INTERVALS + 1) * RATIOS, (double(*)[GROUPS])(w + (INTERVALS + 1) * (RATIOS + 1)),
    w + (INTERVALS + 1) * (RATIOS + 1 + GROUPS), squared,
    (answers*)(w + (INTERVALS + 1) * (RATIOS + 2 + GROUPS)), arg[HELD], CUTS ? arg[2] : 0,
  };
  (void)iw; (void)mem;
  *interval = *sweeps = *duration = 0.0;
  *slowed = 1.0;
  for (int i = 0; i <= INTERVALS; ++i) squared[i] = 0.0;
  reset(use, peak);
  *status = solve(&p, use, peak, interval, sweeps, slowed);
  for (int k = 0; k < KINDS; ++k) {
    uses[3 * k] = use[k].ratio;
    uses[3 * k + 1] = use[k].parameter;
    uses[3 * k + 2] = use[k].column;
  }
  if (*status == REACHED || *status == SLOWED)
    for (int i = 0; i < INTERVALS; ++i)
      *duration += 2.0 / INTERVALS / (sqrt(squared[i]) + sqrt(squared[i + 1]));
  else
    *duration = INFINITY;
  return 0;
}

int path_timing_work(long long* arg, long long* res, long long* iw, long long* w) {
  *arg = HELD + 1; *res = 8; *iw = 0;
  *w = (INTERVALS + 1) * (RATIOS + 2 + GROUPS) + INTERVALS * sizeof(answers) / sizeof(double);
  return 0;
}
void path_timing_incref(void) {}
int path_timing_checkout(void) { return 0; }
void path_timing_release(int mem) { (void)mem; }
