/* Convex quadratic programs of a border and a chain: `interior.py`, step by step, compiled.

   Names are those of that module, where the method and its formulas are; `bordered.c` comes before.
   */

typedef struct {
  double *d, *s, *y, *low, *high;
} State;

enum { ITERATIONS = @ITERATIONS@ };
enum { SOLVED = 0, INFEASIBLE = 1, FAILED = 2 };
static const double TO_BOUNDARY = @TO_BOUNDARY@, PUSH = @PUSH@, LEAST = @LEAST@;
static const double ROUNDING = @ROUNDING@;

static double largest(const double *a, integer n) {
  double most = 0.0;
  for (integer i = 0; i < n; i++) {
    /* NaN must win. */
    if (!(fabs(a[i]) <= most)) most = fabs(a[i]);
  }
  return most;
}

static double mean(const Program *p, const State *now, const State *change, double share,
                   integer rows) {
  const integer all = p->k + p->n;
  double total = 0.0;
  for (integer r = 0; r < rows; r++)
    total += (now->s[r] + share * change->s[r]) * (now->y[r] + share * change->y[r]);
  for (integer i = 0; i < all; i++) {
    const double d = now->d[i] + share * change->d[i];
    total += (d - p->low[i]) * (now->low[i] + share * change->low[i]) +
             (p->high[i] - d) * (now->high[i] + share * change->high[i]);
  }
  return total / (double)(rows + 2 * all);
}

static double shorter(double worst, const double *value, const double *by, integer n) {
  for (integer i = 0; i < n; i++) {
    const double share = -by[i] / value[i];
    if (share > worst) worst = share;
  }
  return worst;
}

/* Share of a change at which the first slack or multiplier is gone. */
static double longest(const Program *p, const State *now, const State *change, integer rows) {
  const integer all = p->k + p->n;
  double worst = 1e-300;
  worst = shorter(worst, now->s, change->s, rows);
  worst = shorter(worst, now->y, change->y, rows);
  worst = shorter(worst, now->low, change->low, all);
  worst = shorter(worst, now->high, change->high, all);
  for (integer i = 0; i < all; i++) {
    const double by = change->d[i];
    const double to_low = -by / (now->d[i] - p->low[i]), to_high = by / (p->high[i] - now->d[i]);
    if (to_low > worst) worst = to_low;
    if (to_high > worst) worst = to_high;
  }
  return 1.0 / worst;
}

/* What changes the products of rows and bounds by `goal`. */
static void changed(const Rows *A, const Factors *f, const State *now, const State *goal,
                    const double *slope, const double *lack, integer rows, double *by_rows,
                    double *right, State *out) {
  const Program *p = A->of;
  const integer all = p->k + p->n;
  for (integer r = 0; r < rows; r++) by_rows[r] = (goal->s[r] + now->y[r] * lack[r]) / now->s[r];
  rows_pulled(A, by_rows, right);
  for (integer i = 0; i < all; i++) {
    const double to_low = now->d[i] - p->low[i], to_high = p->high[i] - now->d[i];
    right[i] = goal->low[i] / to_low - goal->high[i] / to_high - slope[i] - right[i];
  }
  newton(f, right, out->d);
  rows_times(A, out->d, out->s);
  for (integer r = 0; r < rows; r++) {
    out->s[r] = -lack[r] - out->s[r];
    out->y[r] = (goal->s[r] - now->y[r] * out->s[r]) / now->s[r];
  }
  for (integer i = 0; i < all; i++) {
    const double to_low = now->d[i] - p->low[i], to_high = p->high[i] - now->d[i];
    out->low[i] = (goal->low[i] - now->low[i] * out->d[i]) / to_low;
    out->high[i] = (goal->high[i] + now->high[i] * out->d[i]) / to_high;
  }
}

/* Whether the rows, weighed by y, ask for more together than the bounds can give. */
static int is_impossible(const Program *p, const double *y, const double *pull, integer rows) {
  double least = 0.0, size = 0.0, asked = 0.0;
  for (integer i = 0; i < p->k + p->n; i++) {
    least += fmin(pull[i] * p->low[i], pull[i] * p->high[i]);
    size += fabs(pull[i]);
  }
  for (integer r = 0; r < rows; r++) {
    asked += p->b[r] * y[r];
    size += fabs(p->b[r]) * y[r];
  }
  return least > asked + ROUNDING * size;
}


static double *take(double **work, integer size) {
  double *const first = *work;
  *work += size;
  return first;
}

static State state(double **work, integer all, integer rows) {
  State made;
  made.d = take(work, all), made.s = take(work, rows), made.y = take(work, rows);
  made.low = take(work, all), made.high = take(work, all);
  return made;
}

__attribute__((visibility("default"))) integer dual_arm_work(integer k, integer n, integer m) {
  const integer all = k + n, rows = m + 1, wide = whole_vectors(k);
  const integer states = 4 * (3 * all + 2 * rows), matrices = 3 * (k + n) * wide + 4 * n;
  return states + matrices + (m + 2) * wide + 8 * all + 3 * rows;
}

__attribute__((visibility("default"))) integer dual_arm_quadratic(const Program *p) {
  const integer k = p->k, n = p->n, all = k + n, rows = p->m + (p->whole != 0);
  const integer wide = whole_vectors(k);
  double *work = p->work;
  double *const corner = take(&work, k * wide), *const beside = take(&work, n * wide);
  spread(corner, p->corner, k, k, wide);
  spread(beside, p->beside, n, k, wide);
  const Matrix H = {k, n, wide, corner, beside, (double *)p->diagonal, (double *)p->off};
  const Rows A = {p, wide, take(&work, p->m * wide), take(&work, wide)};
  spread(A.border, p->border, p->m, k, wide);
  memset(A.head, 0, sizeof(double) * wide);
  Factors f;
  memset(&f, 0, sizeof f);
  f.of = (Matrix){k, n, wide, take(&work, k * wide), take(&work, n * wide), take(&work, n),
                  take(&work, n)};
  f.pivot = take(&work, n), f.along = take(&work, n);
  f.follow = take(&work, n * wide), f.lower = take(&work, k * wide), f.head = take(&work, wide);
  f.pull = take(&work, all), f.left = take(&work, all), f.more = take(&work, all);
  State now = state(&work, all, rows), goal = state(&work, all, rows);
  State first = state(&work, all, rows), second = state(&work, all, rows);
  double *const slope = take(&work, all), *const bend = take(&work, all);
  double *const pull = take(&work, all), *const E = take(&work, all);
  double *const right = take(&work, all), *const lack = take(&work, rows);
  double *const D = take(&work, rows), *const by_rows = take(&work, rows);

  for (integer i = 0; i < all; i++) {
    const double push = PUSH * (p->high[i] - p->low[i]);
    now.d[i] = fmin(fmax(0.0, p->low[i] + push), p->high[i] - push);
    now.low[i] = LEAST / fmax(now.d[i] - p->low[i], LEAST);
    now.high[i] = LEAST / fmax(p->high[i] - now.d[i], LEAST);
  }
  rows_times(&A, now.d, now.s);
  for (integer r = 0; r < rows; r++) {
    now.s[r] = fmax(p->b[r] - now.s[r], LEAST);
    now.y[r] = LEAST;
  }
  integer ending = FAILED;
  for (int turn = 0; turn < ITERATIONS; turn++) {
    rows_pulled(&A, now.y, pull);
    matrix_times(&H, now.d, bend);
    rows_times(&A, now.d, lack);
    for (integer i = 0; i < all; i++)
      slope[i] = bend[i] + p->g[i] + pull[i] - now.low[i] + now.high[i];
    for (integer r = 0; r < rows; r++) lack[r] += now.s[r] - p->b[r];
    const double mu = mean(p, &now, &now, 0.0, rows), missing = largest(lack, rows);
    if (!isfinite(mu)) break;
    const double size = 1.0 + fmax(largest(bend, all), largest(pull, all));
    const double products = (double)(rows + 2 * all) * mu;
    if (largest(slope, all) / size <= p->tolerance && missing <= p->tolerance &&
        products <= p->tolerance) {
      ending = SOLVED;
      break;
    }
    if (missing > p->tolerance && is_impossible(p, now.y, pull, rows)) {
      ending = INFEASIBLE;
      break;
    }
    for (integer r = 0; r < rows; r++) D[r] = now.y[r] / now.s[r];
    for (integer i = 0; i < all; i++)
      E[i] = now.low[i] / (now.d[i] - p->low[i]) + now.high[i] / (p->high[i] - now.d[i]);
    if (!factorise(&A, &H, &f, D, E)) break;
    for (integer r = 0; r < rows; r++) goal.s[r] = -now.s[r] * now.y[r];
    for (integer i = 0; i < all; i++) {
      goal.low[i] = -(now.d[i] - p->low[i]) * now.low[i];
      goal.high[i] = -(p->high[i] - now.d[i]) * now.high[i];
    }
    changed(&A, &f, &now, &goal, slope, lack, rows, by_rows, right, &first);
    const double way = fmin(1.0, longest(p, &now, &first, rows));
    const double reached = fmax(mean(p, &now, &first, way, rows), 0.0) / mu;
    const double centre = mu * reached * reached * reached;
    for (integer r = 0; r < rows; r++) goal.s[r] += centre - first.s[r] * first.y[r];
    for (integer i = 0; i < all; i++) {
      goal.low[i] += centre - first.d[i] * first.low[i];
      goal.high[i] += centre + first.d[i] * first.high[i];
    }
    changed(&A, &f, &now, &goal, slope, lack, rows, by_rows, right, &second);
    const double share = fmin(1.0, TO_BOUNDARY * longest(p, &now, &second, rows));
    if (!(share > p->tolerance)) break;
    add(now.d, share, second.d, all);
    add(now.s, share, second.s, rows);
    add(now.y, share, second.y, rows);
    add(now.low, share, second.low, all);
    add(now.high, share, second.high, all);
  }
  memcpy(p->d, now.d, sizeof(double) * all);
  memcpy(p->rows, now.y, sizeof(double) * rows);
  for (integer i = 0; i < all; i++) p->bounds[i] = now.high[i] - now.low[i];
  return ending;
}
