/* One step of the dense interior-point method of `dense.py`, where its formulas are.

   Slacks, multipliers and their changes hold the m inequalities first, then the n lower and the n
   upper bounds. */

/* ---- offered ---- */

typedef struct {
  integer n, m;           /* variables, inequalities */
  const double *cost;     /* (n,) */
  const double *low, *high, *inner_low, *inner_high; /* (n,) */
  const double *values;   /* (m,) of the inequalities at the trial */
  const double *W;        /* (n, n) curvature of the Lagrangian */
  double *z, *slack, *dual, *h; /* the iterate */
  double *A;                    /* (m, wide), filled up with zeros */
  double *trial;          /* (n,) variables */
  double *ruling;         /* (m,) weights that the curvature is asked for */
  double *errors;         /* (4,) */
  char *blocking;         /* (m,) rows that shortened the last step */
  double mu;
  double *work;           /* dual_arm_dense_work(n, m) doubles */
  double price, before, slope, alpha; /* of the search along a direction */
} Step;

enum { TAKEN = 0, AGAIN = 1 };

OFFERED integer dual_arm_dense_work(integer n, integer m);
OFFERED void dual_arm_dense_ruling(const Step *s);
OFFERED integer dual_arm_dense_direction(Step *s);
OFFERED integer dual_arm_dense_judge(Step *s);
OFFERED integer dual_arm_dense_heed(const Step *s);
OFFERED void dual_arm_dense_move(const Step *s);
OFFERED void dual_arm_dense_errors(const Step *s);
/* ---- within ---- */

/* Share of the way to a bound that a step may take; factor to the multiplier of a row that shortened
   a step; least slack of all. */
static const double TO_BOUNDARY = 0.99, RAISED = 10.0, LEAST = 1e-9;
/* Share of the predicted gain that a step has to bring; price of a violation, over its multiplier. */
static const double ARMIJO = 1e-4, PENALTY = 2.0;
/* Least and largest share of a refused step that is tried next; parabolas tell which between. */
static const double SHORTENED_LEAST = 0.1, SHORTENED_MOST = 0.7;
/* Share of the largest multiplier below which a row's curvature, most of a step's cost and next to
   nothing of it, is left out; the same of rows whose slack exceeds their multiplier. */
static const double NEGLIGIBLE = 1e-3, DISTANT = 2e-2;
/* First shift of a matrix, as a share of its largest diagonal entry, and the factor to the next. */
static const double SHIFT = 1e-7, SHIFTED = 8.0;
/* Longest step, in widths of the box; longer ones come of matrices that are nearly singular. */
static const double LONGEST = 2.0;
/* Multipliers stay within this factor of what the barrier asks for. */
static const double DUAL_RANGE = 1e10;

/* The parts of the work memory. */
typedef struct {
  double *M, *factor;                 /* (n, wide) */
  double *right, *dz;                 /* (wide,) */
  double *change, *by_dual, *reached; /* (m + 2 n,) */
} Work;

static Work parts(const Step *s) {
  const integer n = s->n, all = s->m + 2 * n, wide = whole_vectors(n);
  double *at = s->work;
  Work w;
  w.M = at, w.factor = at + n * wide, at += 2 * n * wide;
  w.right = at, w.dz = at + wide, at += 2 * wide;
  w.change = at, w.by_dual = at + all, w.reached = at + 2 * all;
  return w;
}

OFFERED integer dual_arm_dense_work(integer n, integer m) {
  const integer wide = whole_vectors(n);
  return 2 * n * wide + 2 * wide + 3 * (m + 2 * n);
}

/* In so many sums, which compilers put into vectors; n is a multiple of them. */
static double dot_wide(const double *a, const double *b, integer n) {
  double sums[VECTOR] = {0.0}, total = 0.0;
  for (integer i = 0; i < n; i += VECTOR)
    for (int j = 0; j < VECTOR; j++) sums[j] += a[i + j] * b[i + j];
  for (int j = 0; j < VECTOR; j++) total += sums[j];
  return total;
}

static double dot(const double *a, const double *b, integer n) {
  double total = 0.0;
  for (integer i = 0; i < n; i++) total += a[i] * b[i];
  return total;
}

static double largest(const double *value, const double *change, integer n, double keep) {
  double steepest = 0.0;
  for (integer i = 0; i < n; i++) steepest = fmin(steepest, change[i] / value[i]);
  return steepest < 0.0 ? fmin(1.0, keep / -steepest) : 1.0;
}

static double keep(const Step *s) { return fmax(TO_BOUNDARY, 1.0 - s->mu); }

static double merit(const Step *s, const double *z, const double *slack, double theta) {
  double logs = 0.0;
  for (integer i = 0; i < s->m + 2 * s->n; i++) logs += log(slack[i]);
  return dot(s->cost, z, s->n) - s->mu * logs + s->price * theta;
}

static void bounds_left(const Step *s, const double *z, double *slack) {
  const integer n = s->n, m = s->m;
  for (integer i = 0; i < n; i++) {
    slack[m + i] = z[i] - s->low[i];
    slack[m + n + i] = s->high[i] - z[i];
  }
}

static void place_trial(Step *s, const double *dz) {
  for (integer i = 0; i < s->n; i++)
    s->trial[i] = fmin(fmax(s->z[i] + s->alpha * dz[i], s->inner_low[i]), s->inner_high[i]);
}

/* Weights of the Lagrangian for the rows whose curvature matters to a step. */
OFFERED void dual_arm_dense_ruling(const Step *s) {
  double most = 0.0;
  for (integer k = 0; k < s->m; k++) most = fmax(most, s->dual[k]);
  for (integer k = 0; k < s->m; k++) {
    const double y = s->dual[k];
    s->ruling[k] = y > (s->slack[k] > y ? DISTANT : NEGLIGIBLE) * most ? -y : 0.0;
  }
}

/* L L^T of a symmetric matrix's lower half; whether it is definite. */
static int factorise(double *a, integer n, integer wide) {
  for (integer j = 0; j < n; j++) {
    double *row = a + j * wide;
    for (integer k = 0; k < j; k++) {
      const double *other = a + k * wide;
      row[k] = (row[k] - dot(row, other, k)) / other[k];
    }
    const double left = row[j] - dot(row, row, j);
    if (!(left > 0.0)) return 0;
    row[j] = sqrt(left);
  }
  return 1;
}

static void solve(const double *factor, integer n, integer wide, double *x) {
  for (integer i = 0; i < n; i++)
    x[i] = (x[i] - dot(factor + i * wide, x, i)) / factor[i * wide + i];
  for (integer i = n - 1; i >= 0; i--) {
    x[i] /= factor[i * wide + i];
    for (integer k = 0; k < i; k++) x[k] -= factor[i * wide + k] * x[i];
  }
}

/* The solution of M dz = right, M shifted until it is definite; whether there is one. */
static int direction(const Step *s, Work *w) {
  const integer n = s->n, wide = whole_vectors(n);
  double shift = 0.0, scale = 1.0;
  for (integer i = 0; i < n; i++) {
    const double size = fabs(w->M[i * wide + i]);
    if (!(size <= scale)) scale = size;
  }
  while (isfinite(scale) && shift < 1e3 * scale) {
    memcpy(w->factor, w->M, sizeof(double) * n * wide);
    for (integer i = 0; i < n; i++) w->factor[i * wide + i] += shift;
    if (factorise(w->factor, n, wide)) {
      memset(w->dz, 0, sizeof(double) * wide);
      memcpy(w->dz, w->right, sizeof(double) * n);
      solve(w->factor, n, wide, w->dz);
      int is_short = 1;
      for (integer i = 0; i < n; i++)
        is_short &= fabs(w->dz[i]) <= LONGEST * (s->high[i] - s->low[i]);
      if (is_short) return 1;
    }
    shift = fmax(SHIFT * scale, SHIFTED * shift);
  }
  return 0;
}

/* A direction, and the first trial along it; whether there is one. */
OFFERED integer dual_arm_dense_direction(Step *s) {
  const integer n = s->n, m = s->m, all = m + 2 * n, wide = whole_vectors(n);
  Work w = parts(s);
  double theta = 0.0, most = 0.0, slope = 0.0;
  memset(w.M, 0, sizeof(double) * n * wide);
  memset(w.right, 0, sizeof(double) * wide);
  for (integer i = 0; i < n; i++) {
    memcpy(w.M + i * wide, s->W + i * n, sizeof(double) * n);
    w.M[i * wide + i] += s->dual[m + i] / s->slack[m + i] + s->dual[m + n + i] / s->slack[m + n + i];
  }
  for (integer k = 0; k < m; k++) {
    const double *row = s->A + k * wide, D = s->dual[k] / s->slack[k];
    add_wide(w.right, s->mu / s->slack[k] - D * (s->h[k] - s->slack[k]), row, wide);
    for (integer i = 0; i < n; i++)
      if (row[i] != 0.0) add_wide(w.M + i * wide, D * row[i], row, whole_vectors(i + 1));
  }
  for (integer i = 0; i < n; i++)
    w.right[i] += s->mu / s->slack[m + i] - s->mu / s->slack[m + n + i] - s->cost[i];
  if (!direction(s, &w)) return 0;
  for (integer k = 0; k < m; k++) {
    const double r = s->h[k] - s->slack[k];
    w.change[k] = dot_wide(s->A + k * wide, w.dz, wide) + r;
    theta += fabs(r);
    most = fmax(most, s->dual[k]);
  }
  for (integer i = 0; i < n; i++) w.change[m + i] = w.dz[i], w.change[m + n + i] = -w.dz[i];
  for (integer i = 0; i < all; i++) {
    const double share = w.change[i] / s->slack[i];
    w.by_dual[i] = s->mu / s->slack[i] - s->dual[i] * share - s->dual[i];
    slope -= s->mu * share;
  }
  s->price = theta != 0.0 ? fmax(s->price, PENALTY * most) : 0.0;
  s->slope = slope + dot(s->cost, w.dz, n) - s->price * theta;
  s->before = merit(s, s->z, s->slack, theta);
  s->alpha = largest(s->slack, w.change, all, keep(s));
  memset(s->blocking, 0, m);
  place_trial(s, w.dz);
  return 1;
}

/* Share of a step until rows that were lost reach a tenth of what they kept, on parabolas; 0 where
   none was lost. */
static double until(const Step *s, const Work *w) {
  double first = INFINITY;
  int any = 0;
  for (integer k = 0; k < s->m; k++) {
    const double value = s->slack[k], change = s->alpha * w->change[k];
    if (!(s->h[k] >= value) || !(s->values[k] < (1.0 - keep(s)) * value)) continue;
    const double bend = fmin(s->values[k] - value - change, -1e-300), room = 0.9 * value;
    first = fmin(first, 2.0 * room / (sqrt(change * change - 4.0 * bend * room) - change));
    s->blocking[k] = any = 1;
  }
  return any ? first : 0.0;
}

/* Judges the trial's values: taken, or a shorter one is placed. */
OFFERED integer dual_arm_dense_judge(Step *s) {
  const integer m = s->m;
  Work w = parts(s);
  int is_finite = 1;
  for (integer k = 0; k < m; k++) is_finite &= isfinite(s->values[k]) != 0;
  double share = SHORTENED_LEAST;
  if (is_finite) {
    const double lost = until(s, &w);
    if (lost > 0.0) {
      share = lost;
    } else {
      double theta = 0.0;
      for (integer k = 0; k < m; k++) {
        const double kept = s->slack[k];
        const double slack = s->h[k] >= kept ? s->values[k] : fmax(kept + s->alpha * w.change[k], s->values[k]);
        w.reached[k] = fmax(slack, LEAST);
        theta += fabs(s->values[k] - w.reached[k]);
      }
      bounds_left(s, s->trial, w.reached);
      const double gain = s->slope * s->alpha;
      const double more = merit(s, s->trial, w.reached, theta) - s->before;
      if (more <= ARMIJO * gain + 1e-14 * fmax(1.0, fabs(s->before))) return TAKEN;
      share = -gain / (2.0 * (more - gain));
    }
  }
  s->alpha *= fmin(fmax(share, SHORTENED_LEAST), SHORTENED_MOST);
  place_trial(s, w.dz);
  return AGAIN;
}

/* Raises the multipliers of rows that shortened the last step; whether any was raised. */
OFFERED integer dual_arm_dense_heed(const Step *s) {
  int any = 0;
  for (integer k = 0; k < s->m; k++) {
    const double y = s->dual[k], raised = fmin(1.0, RAISED * y);
    if (s->blocking[k] && raised > y) s->dual[k] = raised, any = 1;
  }
  return any;
}

/* Moves to the trial that was taken; the rows' slopes there are in A already. */
OFFERED void dual_arm_dense_move(const Step *s) {
  const integer n = s->n, m = s->m, all = m + 2 * n;
  const Work w = parts(s);
  memcpy(s->z, s->trial, sizeof(double) * n);
  memcpy(s->slack, w.reached, sizeof(double) * all);
  memcpy(s->h, s->values, sizeof(double) * m);
  const double share = largest(s->dual, w.by_dual, all, keep(s));
  for (integer i = 0; i < all; i++) {
    const double y = s->dual[i] + share * w.by_dual[i], ideal = s->mu / s->slack[i];
    s->dual[i] = fmin(fmax(y, ideal / DUAL_RANGE), ideal * DUAL_RANGE);
  }
  dual_arm_dense_heed(s);
}

/* Residuals: the largest without complementarity, the least and the largest product, their scale. */
OFFERED void dual_arm_dense_errors(const Step *s) {
  const integer n = s->n, m = s->m, all = m + 2 * n, wide = whole_vectors(n);
  Work w = parts(s);
  double total = 0.0, least = INFINITY, most = -INFINITY, steepest = 0.0, lack = 0.0;
  memset(w.right, 0, sizeof(double) * wide);
  for (integer i = 0; i < all; i++) {
    const double product = s->slack[i] * s->dual[i];
    total += s->dual[i], least = fmin(least, product), most = fmax(most, product);
  }
  for (integer k = 0; k < m; k++) {
    add_wide(w.right, s->dual[k], s->A + k * wide, wide);
    lack = fmax(lack, fabs(s->h[k] - s->slack[k]));
  }
  for (integer i = 0; i < n; i++)
    steepest = fmax(steepest, fabs(s->cost[i] - w.right[i] - s->dual[m + i] + s->dual[m + n + i]));
  const double scale = fmax(1.0, total / (double)all / 100.0);
  s->errors[0] = fmax(steepest / scale, lack), s->errors[1] = least, s->errors[2] = most;
  s->errors[3] = scale;
}
