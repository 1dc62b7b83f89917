/* Second derivatives of the rows of a smooth program; `rows.c` comes before. */

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

static integer add_held(const Program *p);

/* Second derivatives where the slopes were found last. Returns DONE, FAILED, or the number of what
   has to be prepared first: blocks of forces from 1, of loads from 51, of pressure from
   101, arms from 201, groups from 301. */
__attribute__((visibility("default"))) integer dual_arm_rows_curvature(const Program *p) {
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
