/* Convex quadratic programs of a border and a chain, by the method of `quadratic.py`, where its
   formulas are.

   Vectors of all variables hold the border first, then the chain. Rows of matrices are filled up with
   zeros to whole vectors. */

/* ---- offered ---- */

typedef struct {
  integer k, n, m;          /* border, chain, rows */
  const double *corner;     /* (k, k) */
  const double *beside;     /* (n, k) */
  const double *diagonal;   /* (n,) */
  const double *off;        /* (n - 1,) */
  const double *g;          /* (k + n,) */
  const double *border;     /* (m, k) */
  const integer *column;    /* (m,) */
  const double *left;       /* (m,) */
  const double *right;      /* (m,) */
  const double *b;          /* (m,) */
  const double *low, *high; /* (k + n,) */
  double tolerance;
  double *d, *rows, *bounds; /* the answer */
  double *work;              /* dual_arm_work(k, n, m) doubles */
} Program;

enum { SOLVED = 0, INFEASIBLE = 1, FAILED = 2 };

OFFERED integer dual_arm_work(integer k, integer n, integer m);
OFFERED integer dual_arm_quadratic(const Program *p);
/* ---- within ---- */

/* A vector of any alignment; rows of a register tile; rows that are summed at a time, as many as a
   first cache holds. */
typedef double vector __attribute__((vector_size(8 * VECTOR), aligned(8), may_alias));

#ifdef __AVX512F__
enum { TILE = 8 };
#else
enum { TILE = 4 };
#endif
enum { AT_A_TIME = 32 };

/* The rows as they are used here. */
typedef struct {
  const Program *of;
  integer wide;              /* a row of the border with its zeros */
  double *border, *head;     /* (m, wide); (wide,) to work in */
} Rows;

typedef struct {
  integer k, n, wide;        /* border, chain, a row with its zeros */
  double *corner, *beside;   /* (k, wide), with memory for (wide, wide) where it is summed; (n, wide) */
  double *diagonal, *off;
} Matrix;

typedef struct {
  Matrix of;                 /* what is factorised */
  double *pivot, *along;     /* of the chain, L D L^T */
  double *follow, *lower;    /* chain's inverse times beside; of the border, L L^T */
  double *head, *weighted;   /* (wide,), (AT_A_TIME, wide) to work in */
} Factors;

/* In so many sums, which compilers put into vectors. */
static double dot(const double *a, const double *b, integer n) {
  double sums[VECTOR] = {0.0}, rest = 0.0;
  integer i = 0;
  for (; i + VECTOR <= n; i += VECTOR)
    for (int j = 0; j < VECTOR; j++) sums[j] += a[i + j] * b[i + j];
  for (; i < n; i++) rest += a[i] * b[i];
  for (int j = 0; j < VECTOR; j++) rest += sums[j];
  return rest;
}

static void add(double *restrict to, double by, const double *restrict what, integer n) {
  for (integer i = 0; i < n; i++) to[i] += by * what[i];
}

/* TILE rows and one vector of columns of the sum of left^T right over rows (m, wide), in registers. */
static void add_tile(double *to, const double *left, const double *right, integer m, integer wide) {
  vector sums[TILE];
  for (int i = 0; i < TILE; i++) sums[i] = *(const vector *)(to + i * wide);
  for (integer r = 0; r < m; r++) {
    const vector from = *(const vector *)(right + r * wide);
    for (int i = 0; i < TILE; i++) sums[i] += left[r * wide + i] * from;
  }
  for (int i = 0; i < TILE; i++) *(vector *)(to + i * wide) = sums[i];
}

/* The lower half of sums of weight * left^T right over rows (m, wide), to a matrix (k, wide) that has
   memory for `wide` rows; what is above is not to be read. Where `weight` is null, each weight is -1.
   `weighted`: (AT_A_TIME, wide) to work in. */
static void add_products(double *to, const double *weight, const double *left, const double *right,
                         integer m, integer k, integer wide, double *weighted) {
  for (integer r = 0; r < m; r += AT_A_TIME) {
    const integer rows = m - r < AT_A_TIME ? m - r : AT_A_TIME;
    for (integer q = 0; q < rows; q++) {
      const double by = weight ? weight[r + q] : -1.0;
      for (integer j = 0; j < wide; j++) weighted[q * wide + j] = by * left[(r + q) * wide + j];
    }
    for (integer i = 0; i < k; i += TILE)
      for (integer j = 0; j < i + TILE; j += VECTOR)
        add_tile(to + i * wide + j, weighted + i, right + r * wide + j, rows, wide);
  }
}

static void spread(double *to, const double *from, integer rows, integer k, integer wide) {
  memset(to, 0, sizeof(double) * rows * wide);
  for (integer i = 0; i < rows; i++) memcpy(to + i * wide, from + i * k, sizeof(double) * k);
}

/* Rows times a vector. */
static void rows_times(const Rows *rows, const double *d, double *out) {
  const Program *p = rows->of;
  const double *chain = d + p->k;
  memcpy(rows->head, d, sizeof(double) * p->k);
  for (integer r = 0; r < p->m; r++) {
    const integer c = p->column[r];
    out[r] = dot(rows->border + r * rows->wide, rows->head, rows->wide) +
             (p->left[r] * chain[c] + p->right[r] * chain[c + 1]);
  }
}

/* Transposed rows times multipliers. */
static void rows_pulled(const Rows *rows, const double *y, double *out) {
  const Program *p = rows->of;
  double *chain = out + p->k;
  memset(chain, 0, sizeof(double) * p->n);
  memset(rows->head, 0, sizeof(double) * rows->wide);
  for (integer r = 0; r < p->m; r++) {
    const integer c = p->column[r];
    add_wide(rows->head, y[r], rows->border + r * rows->wide, rows->wide);
    chain[c] += p->left[r] * y[r];
    chain[c + 1] += p->right[r] * y[r];
  }
  memcpy(out, rows->head, sizeof(double) * p->k);
}

static void matrix_times(const Matrix *a, const double *d, double *out) {
  const integer k = a->k, n = a->n, wide = a->wide;
  const double *chain = d + k;
  for (integer i = 0; i < k; i++) out[i] = dot(a->corner + i * wide, d, k);
  for (integer i = 0; i < n; i++) {
    add(out, chain[i], a->beside + i * wide, k);
    double sum = dot(a->beside + i * wide, d, k) + a->diagonal[i] * chain[i];
    if (i + 1 < n) sum += a->off[i] * chain[i + 1];
    if (i > 0) sum += a->off[i - 1] * chain[i - 1];
    out[k + i] = sum;
  }
}

/* The chain's inverse times a vector, in place. */
static void chain_solve(const Factors *f, double *right) {
  const integer n = f->of.n;
  for (integer i = 1; i < n; i++) right[i] -= f->along[i - 1] * right[i - 1];
  for (integer i = 0; i < n; i++) right[i] /= f->pivot[i];
  for (integer i = n - 2; i >= 0; i--) right[i] -= f->along[i] * right[i + 1];
}

/* The same of a matrix of whole vectors. */
static void chain_solve_wide(const Factors *f, double *right) {
  const integer n = f->of.n, wide = f->of.wide;
  for (integer i = 1; i < n; i++)
    add_wide(right + i * wide, -f->along[i - 1], right + (i - 1) * wide, wide);
  for (integer i = 0; i < n; i++) {
    const double by = 1.0 / f->pivot[i];
    for (integer j = i * wide; j < (i + 1) * wide; j++) right[j] *= by;
  }
  for (integer i = n - 2; i >= 0; i--)
    add_wide(right + i * wide, -f->along[i], right + (i + 1) * wide, wide);
}

/* The inverse times a vector. */
static void newton(const Factors *f, const double *right, double *out) {
  const integer k = f->of.k, n = f->of.n, wide = f->of.wide;
  double *chain = out + k, *head = f->head;
  memcpy(chain, right + k, sizeof(double) * n);
  memset(head, 0, sizeof(double) * wide);
  memcpy(head, right, sizeof(double) * k);
  chain_solve(f, chain);
  for (integer i = 0; i < n; i++) add_wide(head, -chain[i], f->of.beside + i * wide, wide);
  for (integer i = 0; i < k; i++)
    head[i] = (head[i] - dot(f->lower + i * wide, head, i)) / f->lower[i * wide + i];
  for (integer i = k - 1; i >= 0; i--) {
    head[i] /= f->lower[i * wide + i];
    add(head, -head[i], f->lower + i * wide, i);
  }
  for (integer i = 0; i < n; i++) chain[i] -= dot(f->follow + i * wide, head, wide);
  memcpy(out, head, sizeof(double) * k);
}

/* H + A^T D A + E, of symmetric matrices the lower half; whether it is positive definite. */
static int factorise(const Rows *rows, const Matrix *H, Factors *f, const double *D,
                     const double *E) {
  const Program *p = rows->of;
  const integer k = p->k, n = p->n, wide = rows->wide;
  Matrix *a = &f->of;
  memcpy(a->corner, H->corner, sizeof(double) * k * wide);
  memcpy(a->beside, H->beside, sizeof(double) * n * wide);
  memcpy(a->diagonal, H->diagonal, sizeof(double) * n);
  memcpy(a->off, H->off, sizeof(double) * (n - 1));
  add_products(a->corner, D, rows->border, rows->border, p->m, k, wide, f->weighted);
  for (integer r = 0; r < p->m; r++) {
    const double *row = rows->border + r * wide, left = p->left[r], right = p->right[r], w = D[r];
    if (left == 0.0 && right == 0.0) continue;
    const integer c = p->column[r];
    add_wide(a->beside + c * wide, w * left, row, wide);
    add_wide(a->beside + (c + 1) * wide, w * right, row, wide);
    a->diagonal[c] += w * left * left;
    a->diagonal[c + 1] += w * right * right;
    a->off[c] += w * left * right;
  }
  for (integer i = 0; i < k; i++) {
    a->corner[i * wide + i] += E[i];
    for (integer j = 0; j < i; j++) a->corner[j * wide + i] = a->corner[i * wide + j];
  }
  for (integer i = 0; i < n; i++) a->diagonal[i] += E[k + i];
  for (integer i = 0; i < n; i++) {
    f->pivot[i] = a->diagonal[i] - (i ? f->along[i - 1] * a->off[i - 1] : 0.0);
    if (!(f->pivot[i] > 0.0)) return 0;
    if (i + 1 < n) f->along[i] = a->off[i] / f->pivot[i];
  }
  memcpy(f->follow, a->beside, sizeof(double) * n * wide);
  chain_solve_wide(f, f->follow);
  memcpy(f->lower, a->corner, sizeof(double) * k * wide);
  add_products(f->lower, 0, a->beside, f->follow, n, k, wide, f->weighted);
  for (integer j = 0; j < k; j++) {
    for (integer i = j; i < k; i++)
      f->lower[i * wide + j] -= dot(f->lower + i * wide, f->lower + j * wide, j);
    if (!(f->lower[j * wide + j] > 0.0)) return 0;
    const double root = sqrt(f->lower[j * wide + j]);
    for (integer i = j; i < k; i++) f->lower[i * wide + j] /= root;
  }
  return 1;
}

typedef struct {
  double *d, *s, *y, *low, *high;
} State;

enum { ITERATIONS = 50 }; /* at most; ten to twenty are the rule */
/* Share of the way to a bound that a step may take; least distance of the start from the bounds, as a
   share of their width; least slack and multiplier at the start. */
static const double TO_BOUNDARY = 0.995, PUSH = 0.1, LEAST = 1e-2;
/* Share of its terms that a proof of infeasibility leaves to rounding. */
static const double ROUNDING = 1e-9;

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

OFFERED integer dual_arm_work(integer k, integer n, integer m) {
  const integer all = k + n, rows = m, wide = whole_vectors(k);
  const integer states = 4 * (3 * all + 2 * rows), matrices = (3 * n + k + 2 * wide) * wide + 4 * n;
  return states + matrices + (m + 2 + AT_A_TIME) * wide + 5 * all + 3 * rows;
}

OFFERED integer dual_arm_quadratic(const Program *p) {
  const integer k = p->k, n = p->n, all = k + n, rows = p->m;
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
  f.of = (Matrix){k, n, wide, take(&work, wide * wide), take(&work, n * wide), take(&work, n),
                  take(&work, n)};
  f.pivot = take(&work, n), f.along = take(&work, n);
  f.follow = take(&work, n * wide), f.lower = take(&work, wide * wide), f.head = take(&work, wide);
  f.weighted = take(&work, AT_A_TIME * wide);
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
