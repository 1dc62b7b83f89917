/* Two convex shapes: proof that they are apart by more than a margin, proof that they intersect by
   more than it, or neither.

   The algorithm of Gilbert, Johnson and Keerthi (1988) on the Minkowski difference, of which it
   only ever uses points. Apart: a direction in which all of the difference lies beyond the margin.
   Intersecting: a tetrahedron of its points that holds the ball of that radius about the origin.
   Whatever is not proven within a few steps stays open, as do shapes whose difference has the origin
   in a face of such a tetrahedron. */

enum { BOX, CYLINDER, SPHERE, CAPSULE, HULL };

typedef struct {
  long long kind, first, count; /* of a hull's vertices */
  double size[3];               /* half edges; radius and half length; radius */
} shape;

typedef struct { double R[9], p[3]; } placed;

static inline double dot(const double* a, const double* b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
static inline void minus(const double* a, const double* b, double* c) {
  for (int i = 0; i < 3; ++i) c[i] = a[i] - b[i];
}
static inline void cross(const double* a, const double* b, double* c) {
  c[0] = a[1] * b[2] - a[2] * b[1];
  c[1] = a[2] * b[0] - a[0] * b[2];
  c[2] = a[0] * b[1] - a[1] * b[0];
}

/* The point of a placed shape that lies farthest along u. */
static void farthest(const shape* s, const placed* at, const double* vertices, const double* u,
                     double* point) {
  double l[3], x[3] = {0.0, 0.0, 0.0};
  for (int i = 0; i < 3; ++i) l[i] = at->R[i] * u[0] + at->R[3 + i] * u[1] + at->R[6 + i] * u[2];
  if (s->kind == BOX) {
    for (int i = 0; i < 3; ++i) x[i] = copysign(s->size[i], l[i]);
  } else if (s->kind == HULL) {
    const double *all = vertices + 3 * s->first, *best = all;
    double most = dot(best, l);
    for (long long k = 1; k < s->count; ++k) {
      double along = dot(all + 3 * k, l);
      if (along > most) { most = along; best = all + 3 * k; }
    }
    memcpy(x, best, sizeof x);
  } else {
    int flat = s->kind == CYLINDER;
    double length = sqrt(l[0] * l[0] + l[1] * l[1] + (flat ? 0.0 : l[2] * l[2]));
    double scale = length > 0.0 ? s->size[0] / length : 0.0;
    x[0] = l[0] * scale;
    x[1] = l[1] * scale;
    if (!flat) x[2] = l[2] * scale;
    if (s->kind != SPHERE) x[2] += copysign(s->size[1], l[2]);
  }
  for (int i = 0; i < 3; ++i)
    point[i] = at->R[3 * i] * x[0] + at->R[3 * i + 1] * x[1] + at->R[3 * i + 2] * x[2] + at->p[i];
}

/* The nearest point v to the origin of the simplex W of n corners; W is reduced to the corners
   that carry it, whose number is returned. */
static int nearest_on_segment(double W[][3], double* v) {
  double ab[3];
  minus(W[1], W[0], ab);
  double t = -dot(W[0], ab), length = dot(ab, ab);
  if (t <= 0.0 || t >= length) {
    if (t > 0.0) memcpy(W[0], W[1], sizeof W[0]);
    memcpy(v, W[0], sizeof W[0]);
    return 1;
  }
  for (int i = 0; i < 3; ++i) v[i] = W[0][i] + t / length * ab[i];
  return 2;
}

static int nearest_on_triangle(double W[][3], double* v) {
  double ab[3], ac[3], n[3], edge[3], out[3];
  minus(W[1], W[0], ab);
  minus(W[2], W[0], ac);
  cross(ab, ac, n);
  double area = dot(n, n), best = INFINITY, kept[2][3], at[3];
  int corners = 0, outside = !(area > 0.0);
  for (int k = 0; k < 3; ++k) {
    const double *a = W[k], *b = W[(k + 1) % 3];
    minus(b, a, edge);
    cross(edge, n, out); /* points away from the third corner */
    if (!outside && -dot(a, out) <= 0.0) continue;
    double pair[2][3], u[3];
    memcpy(pair[0], a, sizeof pair[0]);
    memcpy(pair[1], b, sizeof pair[1]);
    int m = nearest_on_segment(pair, u);
    if (dot(u, u) < best) {
      best = dot(u, u);
      corners = m;
      memcpy(kept, pair, sizeof kept);
      memcpy(at, u, sizeof at);
    }
  }
  if (corners) {
    memcpy(W, kept, sizeof kept);
    memcpy(v, at, sizeof at);
    return corners;
  }
  double along = dot(W[0], n) / area;
  for (int i = 0; i < 3; ++i) v[i] = along * n[i];
  return 3;
}

static const int FACES[4][4] = {{0, 1, 2, 3}, {0, 2, 3, 1}, {0, 3, 1, 2}, {1, 3, 2, 0}};

/* The same for a tetrahedron. If it holds the origin, 4 and the distance of its nearest face. */
static int nearest_on_tetrahedron(double W[][3], double* v, double* depth) {
  double best = INFINITY, kept[3][3], at[3];
  int corners = 0;
  *depth = INFINITY;
  for (int k = 0; k < 4; ++k) {
    const double* a = W[FACES[k][0]];
    double ab[3], ac[3], ad[3], n[3];
    minus(W[FACES[k][1]], a, ab);
    minus(W[FACES[k][2]], a, ac);
    minus(W[FACES[k][3]], a, ad);
    cross(ab, ac, n);
    double length = sqrt(dot(n, n)), fourth = dot(ad, n), origin = -dot(a, n);
    if (length > 0.0 && fabs(fourth) > 1e-12 * length && origin * fourth > 0.0) {
      *depth = fmin(*depth, fabs(origin) / length);
      continue;
    }
    double triangle[3][3], u[3];
    for (int i = 0; i < 3; ++i) memcpy(triangle[i], W[FACES[k][i]], sizeof triangle[i]);
    int m = nearest_on_triangle(triangle, u);
    if (dot(u, u) < best) {
      best = dot(u, u);
      corners = m;
      memcpy(kept, triangle, sizeof kept);
      memcpy(at, u, sizeof at);
    }
  }
  if (!corners) return 4;
  memcpy(W, kept, sizeof kept);
  memcpy(v, at, sizeof at);
  return corners;
}

enum { APART = 1, OPEN = 0, INTERSECTING = -1, STEPS = 40 };

static int prejudge_shapes(const shape* A, const placed* a, const shape* B, const placed* b,
                           const double* vertices, double apart, double overlap) {
  double W[4][3], v[3], u[3], x[3], y[3], w[3], depth;
  int n = 0;
  minus(a->p, b->p, v);
  if (!(dot(v, v) > 1e-20)) { v[0] = 1.0; v[1] = v[2] = 0.0; }
  for (int step = 0; step < STEPS; ++step) {
    for (int i = 0; i < 3; ++i) u[i] = -v[i];
    farthest(A, a, vertices, u, x);
    farthest(B, b, vertices, v, y);
    minus(x, y, w);
    /* Every point of the difference lies at least this far along v. */
    double gap = dot(v, w);
    if (gap > 0.0 && gap * gap > apart * apart * dot(v, v)) return APART;
    if (n && dot(v, v) - gap <= 1e-12 * dot(v, v)) return OPEN;
    memcpy(W[n++], w, sizeof w);
    if (n == 1) memcpy(v, w, sizeof w);
    else if (n == 2) n = nearest_on_segment(W, v);
    else if (n == 3) n = nearest_on_triangle(W, v);
    else n = nearest_on_tetrahedron(W, v, &depth);
    if (n == 4) return depth > overlap && depth < INFINITY ? INTERSECTING : OPEN;
    if (!(dot(v, v) > 1e-18)) return OPEN;
  }
  return OPEN;
}
