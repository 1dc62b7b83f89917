/* Forces of joint allocation among the values at samples: `force_values.py`, compiled; `rows.c` comes
   before. They stand behind those of the paper's branches. */

/* Forces where the loads' samples are evaluated at. */
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
