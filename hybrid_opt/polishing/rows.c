/* The rows of a smooth program: `program.py`, `sample_values.py` and `place_values.py`, compiled.

   Names are those of these modules, where the formulas are. Functions of CasADi are called on arrays
   that were prepared for them. Rows at places stand group by group. Matrices that such functions
   return are transposed ones. */

#include <math.h>
#include <string.h>

typedef long long integer;
typedef integer (*Run)(const void *ports, const void *work, integer begin, integer end);

/* A function on prepared arrays; `one` is null where none is prepared yet. */
typedef struct {
  Run one, lanes;
  const void *ports, *work, *lane_work;
} Call;

/* Samples that one function gives. */
typedef struct {
  integer served, n, start; /* samples an evaluation serves; evaluations; the first among all samples */
  integer window;           /* numbers of a basis */
  const double *basis;      /* (n, window) */
  Call first, second;
  double *x, *columns, *weight; /* inputs of the second: columns (n, n_var, window) */
  const double *curvature;      /* (n, n_var, n_var) */
} Block;

typedef struct {
  integer count, blocks, width; /* values of each */
  Block *block;
  double *x;            /* (n_var,) input of all */
  const double *values; /* (count, width) */
  double *gradients;    /* (count, width, n_var) */
  double *weight;       /* (count, width) to work in */
} Samples;

enum { POSE = 6, INPUTS = 6, LOAD = 6 };

/* Samples whose forces are allocated jointly. */
typedef struct {
  integer count, start, size; /* the first among all of the forces' samples; numbers of a state */
  const integer *at;          /* (count,) each one's load */
  Samples *loads;
  Call first, second;
  double *load;                  /* (count, LOAD) input of the first, whose values are the forces' */
  const double *slope, *state;   /* (count, 2, LOAD), (count, size) */
  double *states, *weight;       /* inputs of the second */
  const double *curvature;       /* (count, LOAD, LOAD) */
  integer *active;               /* (count,) to work in */
} Held;

/* Rows of one family at places. */
typedef struct {
  integer start, stop, moving, arms, width; /* arms as bits; entries of a gradient */
  Call first, second;
  const double *gradient;      /* (rows, width) */
  const double *given[INPUTS]; /* (rows, size) inputs of the first; null where there are none */
  double *inputs[INPUTS];      /* those of the second, the weight last */
  integer sizes[INPUTS];
  const double *hessian; /* (rows, width, width) */
} Group;

typedef struct {
  integer places, joints;
  const integer *place; /* (places,) */
  const integer *at;    /* (n,) position of each row's place among them */
  const double *basis;  /* (places, waypoints) */
  Call first, second;
  double *pose; /* (places, size) */
  const double *q, *follow, *pull;
  double *rows;  /* (n, joints) the rows' joints */
  double *pulls; /* (places, joints) to work in */
  integer *active;
  double *poses, *joint, *nu; /* inputs of the second */
  const double *hessian;      /* (places, size + joints, size + joints) */
} Arm;

typedef struct {
  integer n_var, n_path, n_rows, forces, pressed, first_patch;
  integer n, first_place, waypoints, size, groups;
  const double *z, *centre, *half; /* (n_var + 3,), (n_var,) */
  const double *fixed, *offset;    /* (n_rows, n_var + 3), (n_rows,) */
  const integer *force_column, *pressed_column, *pressed_robot;
  const double *mix;               /* (forces, 2) */
  const double *lacking_slope, *x_0; /* (forces, n_var), null without */
  Samples *samples, *patches;
  Held *held;                      /* null without */
  const integer *order, *place;    /* (n,) row of each, and its place */
  const double *scale;             /* (n,) in the order of rows */
  const integer *free_row, *free_column; /* (n_path,) */
  const double *whole, *whole_rate; /* (n, waypoints) */
  const double *free, *free_rate;   /* (m, n_path) bases of every place, by variable */
  const double *still;              /* (waypoints, size) */
  Group *group;
  Arm *arm; /* both */
  double *pose, *rate, *value; /* (n, 6), (n, 6), (n,) */
  double *points, *x;          /* (waypoints, size), (n_var,) */
  double *values, *jacobian, *curvature; /* the answers */
  const double *multipliers;   /* (n_rows,) */
  double negligible; /* share of the largest weight */
} Program;

enum { DONE = 0, FAILED = -1, UNWRAP = -2 };
enum { MOST = 64 }; /* entries of a gradient */

static int runs(const Call *c, integer count) {
  if (count == 0) return 1;
  if (count > 1 && c->lanes) return c->lanes(c->ports, c->lane_work, 0, count) == -1;
  return c->one(c->ports, c->work, 0, count) == -1;
}

static int samples_run(const Samples *s, const double *x, integer n_var) {
  memcpy(s->x, x, sizeof(double) * n_var);
  for (integer k = 0; k < s->blocks; k++)
    if (!runs(&s->block[k].first, s->block[k].n)) return 0;
  return 1;
}

/* out (rows, width) = basis (rows, waypoints) times the first entries of points (., size). */
static void placed(const Program *p, const double *basis, integer rows, integer width, double *out) {
  memset(out, 0, sizeof(double) * rows * width);
  for (integer r = 0; r < rows; r++)
    for (integer k = 0; k < p->waypoints; k++) {
      const double share = basis[r * p->waypoints + k], *point = p->points + k * p->size;
      for (integer i = 0; i < width; i++) out[r * width + i] += share * point[i];
    }
}

/* Whether angles go the short way without being unwrapped. */
static int place_variables(const Program *p) {
  memcpy(p->points, p->still, sizeof(double) * p->waypoints * p->size);
  for (integer v = 0; v < p->n_path; v++)
    p->points[p->free_row[v] * p->size + p->free_column[v]] = p->x[v];
  for (integer k = 1; k < p->waypoints; k++)
    for (integer i = 3; i < POSE; i++)
      if (fabs(p->points[k * p->size + i] - p->points[(k - 1) * p->size + i]) > M_PI) return 0;
  return 1;
}

static int places_run(const Program *p) {
  placed(p, p->whole, p->n, POSE, p->pose);
  placed(p, p->whole_rate, p->n, POSE, p->rate);
  for (const Arm *arm = p->arm; arm < p->arm + 2; arm++) {
    if (!arm->places) continue;
    placed(p, arm->basis, arm->places, p->size, arm->pose);
    if (!runs(&arm->first, arm->places)) return 0;
    for (integer r = 0; r < p->n; r++)
      memcpy(arm->rows + r * arm->joints, arm->q + arm->at[r] * arm->joints,
             sizeof(double) * arm->joints);
  }
  for (const Group *g = p->group; g < p->group + p->groups; g++)
    if (!runs(&g->first, g->stop - g->start)) return 0;
  return 1;
}

static int held_run(const Program *p);
static void held_slopes(const Program *p);

/* Values at z; `unwrapped` tells that the waypoints are placed already. */
__attribute__((visibility("default"))) integer dual_arm_rows_values(const Program *p,
                                                                    integer unwrapped) {
  const integer nv = p->n_var, n = nv + 3;
  for (integer i = 0; i < nv; i++) p->x[i] = p->centre[i] + p->half[i] * p->z[i];
  for (integer r = 0; r < p->n_rows; r++) {
    const double *fixed = p->fixed + r * n;
    p->values[r] = p->offset[r];
    for (integer i = nv; i < n; i++) p->values[r] += fixed[i] * p->z[i];
  }
  if (!samples_run(p->samples, p->x, nv)) return FAILED;
  if (p->held && !held_run(p)) return FAILED;
  for (integer r = 0; r < p->forces; r++) {
    const double *split = p->samples->values + 2 * p->force_column[r];
    p->values[r] += p->mix[2 * r] * split[0] + p->mix[2 * r + 1] * split[1];
    if (p->lacking_slope)
      for (integer i = 0; i < nv; i++)
        p->values[r] += p->lacking_slope[r * nv + i] * (p->x[i] - p->x_0[i]);
  }
  if (p->pressed && !samples_run(p->patches, p->x, nv)) return FAILED;
  for (integer r = 0; r < p->pressed; r++)
    p->values[p->first_patch + r] +=
        p->patches->values[2 * p->pressed_column[r] + p->pressed_robot[r]];
  if (!p->n) return DONE;
  if (!unwrapped && !place_variables(p)) return UNWRAP;
  if (!places_run(p)) return FAILED;
  for (integer k = 0; k < p->n; k++)
    p->values[p->first_place + p->order[k]] = p->value[k] / p->scale[p->order[k]];
  return DONE;
}

/* Where the joints of an arm stand in the gradient of a group. */
static integer joints_at(const Program *p, const Group *g, int arm) {
  return POSE + (g->moving ? POSE : 0) + (arm == 1 && (g->arms & 1) ? p->arm[0].joints : 0);
}

/* The Jacobian where the values were found last. */
__attribute__((visibility("default"))) void dual_arm_rows_slopes(const Program *p) {
  const integer nv = p->n_var, n = nv + 3, size = p->size;
  memcpy(p->jacobian, p->fixed, sizeof(double) * p->n_rows * n);
  if (p->held) held_slopes(p);
  for (integer r = 0; r < p->forces; r++) {
    const double *slope = p->samples->gradients + 2 * nv * p->force_column[r];
    for (integer i = 0; i < nv; i++) {
      double total = p->mix[2 * r] * slope[i] + p->mix[2 * r + 1] * slope[nv + i];
      if (p->lacking_slope) total += p->lacking_slope[r * nv + i];
      p->jacobian[r * n + i] = total * p->half[i];
    }
  }
  for (integer r = 0; r < p->pressed; r++) {
    const integer at = 2 * p->pressed_column[r] + p->pressed_robot[r];
    for (integer i = 0; i < nv; i++)
      p->jacobian[(p->first_patch + r) * n + i] = p->patches->gradients[at * nv + i] * p->half[i];
  }
  for (const Group *g = p->group; g < p->group + p->groups; g++)
    for (integer k = g->start; k < g->stop; k++) {
      const double *gradient = g->gradient + (k - g->start) * g->width;
      double by_pose[MOST] = {0.0}, by_rate[MOST] = {0.0};
      memcpy(by_pose, gradient, sizeof(double) * POSE);
      if (g->moving) memcpy(by_rate, gradient + POSE, sizeof(double) * POSE);
      for (int a = 0; a < 2; a++) {
        if (!(g->arms & (1 << a))) continue;
        const Arm *arm = p->arm + a;
        const double *slopes = gradient + joints_at(p, g, a);
        const double *follow = arm->follow + arm->at[k] * size * arm->joints;
        for (integer i = 0; i < size; i++)
          for (integer j = 0; j < arm->joints; j++)
            by_pose[i] += follow[i * arm->joints + j] * slopes[j];
      }
      const double *free = p->free + p->place[k] * p->n_path;
      const double *free_rate = p->free_rate + p->place[k] * p->n_path;
      double *row = p->jacobian + (p->first_place + p->order[k]) * n;
      for (integer v = 0; v < p->n_path; v++) {
        const integer c = p->free_column[v];
        const double total = free[v] * by_pose[c] + free_rate[v] * by_rate[c];
        row[v] = total / p->scale[p->order[k]] * p->half[v];
      }
    }
}
