/* Matrices of a border and a chain: what the interior-point method needs of `bordered.py`, compiled.

   Vectors of all variables hold the border first, then the chain; vectors of all rows the whole row
   last, if there is one. Rows of matrices are filled up with zeros to whole vectors. */

#include <math.h>
#include <string.h>

typedef long long integer;

typedef struct {
  integer k, n, m;          /* border, chain, rows but the whole one */
  const double *corner;     /* (k, k) */
  const double *beside;     /* (n, k) */
  const double *diagonal;   /* (n,) */
  const double *off;        /* (n - 1,) */
  const double *g;          /* (k + n,) */
  const double *border;     /* (m, k) */
  const integer *column;    /* (m,) */
  const double *left;       /* (m,) */
  const double *right;      /* (m,) */
  const double *b;          /* (all rows,) */
  const double *low, *high; /* (k + n,) */
  const double *whole;      /* (k + n,), null without */
  double tolerance;
  double *d, *rows, *bounds; /* the answer */
  double *work;              /* dual_arm_work(k, n, m) doubles */
} Program;

/* The rows as they are used here. */
typedef struct {
  const Program *of;
  integer wide;              /* a row of the border with its zeros */
  double *border, *head;     /* (m, wide); (wide,) to work in */
} Rows;

typedef struct {
  integer k, n, wide;        /* border, chain, a row with its zeros */
  double *corner, *beside;   /* (k, wide), (n, wide) */
  double *diagonal, *off;
} Matrix;

typedef struct {
  Matrix of;                 /* what is factorised */
  double *pivot, *along;     /* of the chain, L D L^T */
  double *follow, *lower;    /* chain's inverse times beside; of the border, L L^T */
  const double *whole;
  double weight;             /* of the whole row */
  double *pull, share;       /* the inverse times the whole row, for Sherman and Morrison */
  double *left, *more, *head;
} Factors;

enum { VECTOR = 8, REFINED = @REFINED@ };

static integer whole_vectors(integer n) { return (n + VECTOR - 1) / VECTOR * VECTOR; }

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

/* The same of whole vectors. */
static void add_wide(double *restrict to, double by, const double *restrict what, integer n) {
  for (integer i = 0; i < n; i += VECTOR)
    for (int j = 0; j < VECTOR; j++) to[i + j] += by * what[i + j];
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
  if (p->whole) out[p->m] = dot(p->whole, d, p->k + p->n);
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
  if (p->whole) add(out, y[p->m], p->whole, p->k + p->n);
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
  for (integer i = 0; i < n * wide; i++) right[i] /= f->pivot[i / wide];
  for (integer i = n - 2; i >= 0; i--)
    add_wide(right + i * wide, -f->along[i], right + (i + 1) * wide, wide);
}

static void plain_solve(const Factors *f, const double *right, double *out) {
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

/* One row more is a matrix of rank one more, which cancels digits. */
static void newton(const Factors *f, const double *right, double *out) {
  const integer all = f->of.k + f->of.n;
  if (!f->whole) {
    plain_solve(f, right, out);
    return;
  }
  memset(out, 0, sizeof(double) * all);
  for (int turn = 0; turn < REFINED; turn++) {
    matrix_times(&f->of, out, f->left);
    const double held = f->weight * dot(f->whole, out, all);
    for (integer i = 0; i < all; i++) f->left[i] = right[i] - f->left[i] - held * f->whole[i];
    plain_solve(f, f->left, f->more);
    const double back = f->share * dot(f->whole, f->more, all);
    for (integer i = 0; i < all; i++) out[i] += f->more[i] - back * f->pull[i];
  }
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
  for (integer r = 0; r < p->m; r++) {
    const double *row = rows->border + r * wide, left = p->left[r], right = p->right[r], w = D[r];
    for (integer i = 0; i < k; i++)
      add_wide(a->corner + i * wide, w * row[i], row, whole_vectors(i + 1));
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
  for (integer i = 0; i < n; i++)
    for (integer j = 0; j < k; j++)
      add_wide(f->lower + j * wide, -a->beside[i * wide + j], f->follow + i * wide,
               whole_vectors(j + 1));
  for (integer j = 0; j < k; j++) {
    for (integer i = j; i < k; i++)
      f->lower[i * wide + j] -= dot(f->lower + i * wide, f->lower + j * wide, j);
    if (!(f->lower[j * wide + j] > 0.0)) return 0;
    const double root = sqrt(f->lower[j * wide + j]);
    for (integer i = j; i < k; i++) f->lower[i * wide + j] /= root;
  }
  if (p->whole) {
    f->whole = p->whole, f->weight = D[p->m];
    plain_solve(f, p->whole, f->pull);
    f->share = 1.0 / (1.0 / f->weight + dot(p->whole, f->pull, k + n));
  }
  return 1;
}
