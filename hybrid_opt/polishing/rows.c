/* The rows of a smooth program: values, slopes, weighted second derivatives.

   `rows.py` lays the arrays out; `symbolic/smooth/places.py` has the formulas. Functions of CasADi are
   called on arrays that were prepared for them; matrices that they return are transposed ones. Rows at
   places stand family by family. */

/* ---- offered ---- */
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
  integer n_var, n_path, n_rows, width, forces, pressed, first_patch; /* of a row of the Jacobian */
  integer n, first_place, waypoints, size, groups;
  const double *x, *tail;          /* (n_var,), (width - n_var,) where rows are evaluated */
  const double *fixed, *offset;    /* (n_rows, width - n_var), (n_rows,) */
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
  double *points;              /* (waypoints, size) */
  double *values, *jacobian, *curvature; /* the answers */
  const double *multipliers;   /* (n_rows,) */
  double negligible; /* share of the largest weight */
} Program;

enum { DONE = 0, FAILED = -1, UNWRAP = -2 };

OFFERED integer dual_arm_rows_values(const Program *p, integer unwrapped);
OFFERED void dual_arm_rows_slopes(const Program *p);
OFFERED integer dual_arm_rows_curvature(const Program *p);
/* ---- within ---- */

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

/* Forces of joint allocation stand behind those of the paper's branches: here where the loads'
   samples are evaluated. */
static int held_run(const Program *p) {
  const Held *h = p->held;
  if (!samples_run(h->loads, p->x, p->n_var)) return 0;
  for (integer k = 0; k < h->count; k++)
    memcpy(h->load + k * LOAD, h->loads->values + h->at[k] * LOAD, sizeof(double) * LOAD);
  return runs(&h->first, h->count);
}

/* Their gradients there, from the loads'. */
static void held_slopes(const Program *p) {
  const Held *h = p->held;
  const integer nv = p->n_var;
  for (integer k = 0; k < h->count; k++)
    for (integer i = 0; i < 2; i++) {
      const double *by_load = h->slope + (2 * k + i) * LOAD;
      const double *loads = h->loads->gradients + h->at[k] * LOAD * nv;
      double *to = p->samples->gradients + (2 * (h->start + k) + i) * nv;
      memset(to, 0, sizeof(double) * nv);
      for (integer j = 0; j < LOAD; j++)
        for (integer v = 0; v < nv; v++) to[v] += by_load[j] * loads[j * nv + v];
    }
}

/* Values at z; `unwrapped` tells that the waypoints are placed already. */
OFFERED integer dual_arm_rows_values(const Program *p, integer unwrapped) {
  const integer nv = p->n_var, tail = p->width - nv;
  for (integer r = 0; r < p->n_rows; r++) {
    p->values[r] = p->offset[r];
    for (integer i = 0; i < tail; i++) p->values[r] += p->fixed[r * tail + i] * p->tail[i];
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
    p->values[p->first_place + p->order[k]] += p->value[k] / p->scale[p->order[k]];
  return DONE;
}

/* Where the joints of an arm stand in the gradient of a group. */
static integer joints_at(const Program *p, const Group *g, int arm) {
  return POSE + (g->moving ? POSE : 0) + (arm == 1 && (g->arms & 1) ? p->arm[0].joints : 0);
}

/* The Jacobian's columns by x where the values were found last. */
OFFERED void dual_arm_rows_slopes(const Program *p) {
  const integer nv = p->n_var, n = p->width, size = p->size;
  if (p->held) held_slopes(p);
  for (integer r = 0; r < p->forces; r++) {
    const double *slope = p->samples->gradients + 2 * nv * p->force_column[r];
    for (integer i = 0; i < nv; i++) {
      double total = p->mix[2 * r] * slope[i] + p->mix[2 * r + 1] * slope[nv + i];
      if (p->lacking_slope) total += p->lacking_slope[r * nv + i];
      p->jacobian[r * n + i] = total;
    }
  }
  for (integer r = 0; r < p->pressed; r++) {
    const integer at = 2 * p->pressed_column[r] + p->pressed_robot[r];
    for (integer i = 0; i < nv; i++)
      p->jacobian[(p->first_patch + r) * n + i] = p->patches->gradients[at * nv + i];
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
        row[v] = total / p->scale[p->order[k]];
      }
    }
}

/* Adds left^T block right over the variables of the path. */
static void add_block(const Program *p, const double *block, integer width, const double *left,
                      const double *right, integer size) {
  for (integer v = 0; v < p->n_path; v++) {
    const integer row = p->free_column[v];
    if (left[v] == 0.0 || row >= size) continue;
    double *to = p->curvature + v * p->n_var;
    for (integer w = 0; w < p->n_path; w++)
      if (p->free_column[w] < size)
        to[w] += left[v] * right[w] * block[row * width + p->free_column[w]];
  }
}

/* T^T H T by the extended pose: H (width, width) by its first `own` entries and by joints, which
   follow the pose by F (size, joints). */
static void reduced(const double *H, integer width, integer own, const double *F, integer size,
                    double *block) {
  const integer joints = width - own;
  double follow[MOST * MOST];
  memset(block, 0, sizeof(double) * size * size);
  for (integer i = 0; i < size; i++)
    for (integer b = 0; b < width; b++) {
      double total = 0.0;
      for (integer j = 0; j < joints; j++) total += F[i * joints + j] * H[(own + j) * width + b];
      follow[i * MOST + b] = total;
    }
  for (integer i = 0; i < size; i++)
    for (integer b = 0; b < size; b++) {
      double total = i < own && b < own ? H[i * width + b] : 0.0;
      if (b < own) total += follow[i * MOST + b];
      if (i < own) total += follow[b * MOST + i];
      for (integer j = 0; j < joints; j++) total += follow[i * MOST + own + j] * F[b * joints + j];
      block[i * size + b] = total;
    }
}

/* Adds the weighted second derivatives of samples; what has to be prepared first, or 0. */
static integer add_samples(const Program *p, Samples *s) {
  const integer nv = p->n_var;
  double most = 0.0;
  for (integer k = 0; k < s->width * s->count; k++) most = fmax(most, fabs(s->weight[k]));
  for (Block *b = s->block; b < s->block + s->blocks; b++) {
    integer count = 0;
    const integer each = s->width * b->served;
    for (integer k = 0; k < b->n; k++) {
      const double *weight = s->weight + s->width * b->start + k * each;
      int matters = 0;
      for (integer i = 0; i < each; i++) matters |= fabs(weight[i]) > p->negligible * most;
      if (!matters) continue;
      if (!b->second.one) return 1 + (b - s->block);
      for (integer v = 0; v < nv; v++) {
        const integer at = count * nv + v;
        memcpy(b->columns + at * b->window, b->basis + k * b->window, sizeof(double) * b->window);
        memcpy(b->weight + at * each, weight, sizeof(double) * each);
      }
      count++;
    }
    if (!count) continue;
    memcpy(b->x, p->x, sizeof(double) * nv);
    if (!runs(&b->second, count * nv)) return FAILED;
    for (integer k = 0; k < count; k++)
      for (integer i = 0; i < nv * nv; i++) p->curvature[i] += b->curvature[k * nv * nv + i];
  }
  return 0;
}

/* Adds the second derivatives of a group's rows; likewise. */
static integer add_group(const Program *p, const Group *g, double most) {
  const integer size = p->size, width = g->width, own = POSE;
  integer count = 0, chosen[g->stop - g->start + 1];
  double block[MOST * MOST], F[MOST * MOST];
  for (integer k = g->start; k < g->stop; k++) {
    const double weight = p->multipliers[p->first_place + p->order[k]] / p->scale[p->order[k]];
    if (!(fabs(weight) > p->negligible * most)) continue;
    if (!g->second.one) return 1;
    for (int i = 0; i < INPUTS - 1; i++)
      if (g->given[i])
        memcpy(g->inputs[i] + count * g->sizes[i], g->given[i] + (k - g->start) * g->sizes[i],
               sizeof(double) * g->sizes[i]);
    g->inputs[INPUTS - 1][count] = weight;
    chosen[count++] = k;
  }
  if (!runs(&g->second, count)) return FAILED;
  for (integer c = 0; c < count; c++) {
    const integer k = chosen[c], place = p->place[k];
    const double *H = g->hessian + c * width * width, *free = p->free + place * p->n_path;
    const double *free_rate = p->free_rate + place * p->n_path;
    if (g->moving) {
      const double *bases[] = {free, free_rate};
      for (int i = 0; i < 2; i++)
        for (int j = 0; j < 2; j++)
          add_block(p, H + POSE * i * width + POSE * j, width, bases[i], bases[j], POSE);
      continue;
    }
    const integer joints = width - own;
    integer before = 0;
    for (int a = 0; a < 2; a++) {
      if (!(g->arms & (1 << a))) continue;
      const Arm *arm = p->arm + a;
      const integer at = arm->at[k];
      const double *slopes = g->gradient + (k - g->start) * width + joints_at(p, g, a);
      for (integer j = 0; j < arm->joints; j++)
        arm->pulls[at * arm->joints + j] += g->inputs[INPUTS - 1][c] * slopes[j];
      for (integer i = 0; i < size; i++)
        memcpy(F + i * joints + before, arm->follow + (at * size + i) * arm->joints,
               sizeof(double) * arm->joints);
      before += arm->joints;
    }
    reduced(H, width, own, F, size, block);
    add_block(p, block, size, free, free, size);
  }
  return 0;
}

/* Adds what the arms' joints bend by following the box; likewise. */
static integer add_arm(const Program *p, const Arm *arm) {
  const integer size = p->size, nj = arm->joints, width = size + nj;
  integer count = 0;
  double block[MOST * MOST];
  for (integer k = 0; k < arm->places; k++) {
    const double *pulls = arm->pulls + k * nj, *pull = arm->pull + k * nj * nj;
    int is_active = 0;
    for (integer j = 0; j < nj; j++) is_active |= pulls[j] != 0.0;
    if (!is_active) continue;
    if (!arm->second.one) return 1;
    memcpy(arm->poses + count * size, arm->pose + k * size, sizeof(double) * size);
    memcpy(arm->joint + count * nj, arm->q + k * nj, sizeof(double) * nj);
    for (integer i = 0; i < nj; i++) {
      arm->nu[count * nj + i] = 0.0;
      for (integer j = 0; j < nj; j++) arm->nu[count * nj + i] += pull[i * nj + j] * pulls[j];
    }
    arm->active[count++] = k;
  }
  if (!runs(&arm->second, count)) return FAILED;
  for (integer c = 0; c < count; c++) {
    const integer k = arm->active[c];
    const double *free = p->free + arm->place[k] * p->n_path;
    reduced(arm->hessian + c * width * width, width, size, arm->follow + k * size * nj, size, block);
    add_block(p, block, size, free, free, size);
  }
  return 0;
}

/* Adds J^T H J of one sample, J (LOAD, n_var). */
static void add_bent(const Program *p, const double *H, const double *J) {
  const integer nv = p->n_var;
  for (integer i = 0; i < LOAD; i++)
    for (integer v = 0; v < nv; v++) {
      double total = 0.0;
      for (integer j = 0; j < LOAD; j++) total += H[i * LOAD + j] * J[j * nv + v];
      for (integer w = 0; w < nv; w++) p->curvature[v * nv + w] += total * J[i * nv + w];
    }
}

/* Adds their weighted second derivatives; what the loads have to prepare first, or 0. */
static integer add_held(const Program *p) {
  const Held *h = p->held;
  const Samples *s = p->samples;
  double most = 0.0;
  integer count = 0, lacks;
  for (integer k = 0; k < 2 * s->count; k++) most = fmax(most, fabs(s->weight[k]));
  memset(h->loads->weight, 0, sizeof(double) * LOAD * h->loads->count);
  for (integer k = 0; k < h->count; k++) {
    const double *weight = s->weight + 2 * (h->start + k);
    if (!(fmax(fabs(weight[0]), fabs(weight[1])) > p->negligible * most)) continue;
    for (integer i = 0; i < 2; i++)
      for (integer j = 0; j < LOAD; j++)
        h->loads->weight[h->at[k] * LOAD + j] += weight[i] * h->slope[(2 * k + i) * LOAD + j];
    memcpy(h->weight + 2 * count, weight, sizeof(double) * 2);
    memcpy(h->states + count * h->size, h->state + k * h->size, sizeof(double) * h->size);
    h->active[count++] = h->at[k];
  }
  if ((lacks = add_samples(p, h->loads))) return lacks;
  if (!runs(&h->second, count)) return FAILED;
  for (integer c = 0; c < count; c++)
    add_bent(p, h->curvature + c * LOAD * LOAD,
             h->loads->gradients + h->active[c] * LOAD * p->n_var);
  return 0;
}

/* Second derivatives where the slopes were found last. Returns DONE, FAILED, or the number of what
   has to be prepared first: blocks of forces from 1, of loads from 51, of pressure from
   101, arms from 201, groups from 301. */
OFFERED integer dual_arm_rows_curvature(const Program *p) {
  const integer nv = p->n_var;
  integer lacks;
  memset(p->curvature, 0, sizeof(double) * nv * nv);
  memset(p->samples->weight, 0, sizeof(double) * 2 * p->samples->count);
  for (integer r = 0; r < p->forces; r++)
    for (int i = 0; i < 2; i++)
      p->samples->weight[2 * p->force_column[r] + i] += p->multipliers[r] * p->mix[2 * r + i];
  if ((lacks = add_samples(p, p->samples))) return lacks;
  if (p->held && (lacks = add_held(p))) return lacks < 0 ? lacks : 50 + lacks;
  if (p->pressed) {
    memset(p->patches->weight, 0, sizeof(double) * 2 * p->patches->count);
    for (integer r = 0; r < p->pressed; r++)
      p->patches->weight[2 * p->pressed_column[r] + p->pressed_robot[r]] +=
          p->multipliers[p->first_patch + r];
    if ((lacks = add_samples(p, p->patches))) return lacks < 0 ? lacks : 100 + lacks;
  }
  double most = 0.0;
  for (integer k = 0; k < p->n; k++)
    most = fmax(most, fabs(p->multipliers[p->first_place + k] / p->scale[k]));
  for (int a = 0; a < 2; a++)
    memset(p->arm[a].pulls, 0, sizeof(double) * p->arm[a].places * p->arm[a].joints);
  for (integer g = 0; g < p->groups; g++)
    if ((lacks = add_group(p, p->group + g, most))) return lacks < 0 ? lacks : 301 + g;
  for (int a = 0; a < 2; a++)
    if ((lacks = add_arm(p, p->arm + a))) return lacks < 0 ? lacks : 201 + a;
  return DONE;
}
