/* Batches in lanes. Each lane takes one evaluation; lanes beyond the batch repeat its last. */
DUAL_ARM_EXPORT long long dual_arm_lanes(void) { return DUAL_ARM_LANES; }

/* Which arguments are the same in all lanes. */
static const char dual_arm_shared_inputs[] = {@SHARED@};
DUAL_ARM_EXPORT long long dual_arm_shared(long long i) { return dual_arm_shared_inputs[i]; }

#if DUAL_ARM_LANES > 1
/* The entries of one argument of evaluations k to k + m, each entry's lanes side by side. */
static void dual_arm_gather(const dual_arm_port* port, long long size, long long k, long long m,
                            lanes_real* to) {
  for (long long l = 0; l < DUAL_ARM_LANES; ++l) {
    const double* from = port->base + (k + (l < m ? l : m - 1)) * port->step;
    double* lane = (double*)to + l;
    for (long long j = 0; j < size; ++j) lane[j * DUAL_ARM_LANES] = from[j];
  }
}

static void dual_arm_scatter(const lanes_real* from, long long size, long long k, long long m,
                             const dual_arm_port* port) {
  for (long long l = 0; l < m; ++l) {
    double* to = (double*)port->base + (k + l) * port->step;
    const double* lane = (const double*)from + l;
    for (long long j = 0; j < size; ++j) to[j] = lane[j * DUAL_ARM_LANES];
  }
}

/* As dual_arm_run; work->w holds room for `dual_arm_sizes` numbers in every lane. */
DUAL_ARM_EXPORT long long dual_arm_run_lanes(const dual_arm_port* ports,
                                             const dual_arm_work* work, long long begin,
                                             long long end) {
  static const long long sizes[] = {@SIZES@};
  const dual_arm_port* results = ports + @N_IN@;
  const lanes_real** arg = (const lanes_real**)work->arg;
  lanes_real** res = (lanes_real**)work->res;
  for (long long k = begin; k < end; k += DUAL_ARM_LANES) {
    long long m = end - k < DUAL_ARM_LANES ? end - k : DUAL_ARM_LANES;
    lanes_real* own = (lanes_real*)work->w;
    for (int i = 0; i < @N_IN@; ++i) {
      arg[i] = ports[i].base ? own : 0;
      if (dual_arm_shared_inputs[i]) arg[i] = (const lanes_real*)ports[i].base;
      if (!ports[i].base || dual_arm_shared_inputs[i]) continue;
      if (ports[i].step || k == begin) dual_arm_gather(ports + i, sizes[i], k, m, own);
      own += sizes[i];
    }
    for (int i = 0; i < @N_OUT@; ++i) {
      res[i] = results[i].base ? own : 0;
      if (results[i].base) own += sizes[@N_IN@ + i];
    }
    if (@LANE_FUNCTION@(arg, res, work->iw, own, 0)) return k;
    for (int i = 0; i < @N_OUT@; ++i)
      if (results[i].base) dual_arm_scatter(res[i], sizes[@N_IN@ + i], k, m, results + i);
  }
  return -1;
}
#endif
