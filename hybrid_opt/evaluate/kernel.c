/* Candidates in lanes, from the decision vector to the verdict on every sample.

   Behind the cell's functions `path`, `start`, `predict`, `sample`, `clearance` and `piece_poses` in
   lanes (symbolic.functions). Proofs of pairs that the bounds leave open come from a function that the
   caller hands over (hybrid_opt/collision/distances.cpp). The numbers in capitals are defined by hybrid_opt/evaluate/kernel.py, and per function f of the above the macro
   f_GIVEN, which puts the cell's numbers behind its other arguments: as they are where f_SHARED. */

/* A pair of one sample that neither bounds nor proofs decide. */
typedef struct {
  long long candidate, sample, pair;
  double configuration[CONFIGURATION]; /* box pose, joints of both arms */
} open_pair;

typedef struct { long long pair; double place[3], departure; } resting_place;

/* Proves that two bodies are farther apart than `apart` or intersect deeper than `overlap`. Poses of
   all pieces: quaternions and positions, their numbers `stride` apart. direction: from the first body
   towards the second, zero at first; the next query begins with it. */
enum { APART = 1, OPEN = 0, INTERSECTING = -1 };
typedef int (*decide_pair)(const void* bodies, const double* quaternions, const double* positions,
                           long long stride, long long first, long long second, double apart,
                           double overlap, double* direction);

/* Lower bounds of a pair's distance over the positions of two joints of a robot, by cells of one turn
   of each (hybrid_opt/collision/joint_tables.py); bounds is null where there are none. */
typedef struct { const float* bounds; long long robot, joint; } joint_table;

/* The cell's pairs. columns: of each among all bounds; shrunk_payload: a further body, for the
   payload where it rests. */
typedef struct {
  const long long *pairs, *columns;
  const resting_place* resting;
  const joint_table* tables; /* of each pair */
  const double *free_beyond, *tolerance; /* of each pair */
  long long n_pairs, has_far, n_resting, shrunk_payload;
  double margin;
  const void* bodies;
  decide_pair decide;
} judge_data;

/* Results of n candidates, an axis over them first. wanted: per output of `sample`, (n, samples,
   size) or null. */
typedef struct {
  const double *x, *begin, *numbers; /* begin: both arms' joints at the first box pose; numbers: all
                                        groups of the cell's */
  long long n, with_collisions, all_forces, room;
  double *time, *violation, *violation_time;
  long long *first_sample, *first_reason, *reached;
  unsigned char* colliding;
  double** wanted;
  open_pair* open;
  long long n_open;
} batch_data;

#define STATE MOST(start_OUT_0, start_OUT_1)
#define MOST(a, b) ((a) > (b) ? (a) : (b))
#define MOST_OF(what)                                                                        \
  MOST(MOST(MOST(path_##what, start_##what), MOST(predict_##what, sample_##what)),           \
       MOST(MOST(clearance_##what, FAR_##what), piece_poses_##what))
#if N_NEAR < N_PAIRS
#define FAR_ARG far_clearance_ARG
#define FAR_RES far_clearance_RES
#define FAR_IW far_clearance_IW
#define FAR_W far_clearance_W
#else
#define FAR_ARG 0
#define FAR_RES 0
#define FAR_IW 0
#define FAR_W 0
#endif
#ifdef FORCES_COME_LAST
#define MOST_OF_ALL(what) MOST(MOST_OF(what), forces_##what)
#else
#define MOST_OF_ALL(what) MOST_OF(what)
#endif
#define AFTER_STATES 2 /* outputs of `sample` before those that can be asked for */

typedef struct {
  lanes_real x[N_VAR], time[N_SAMPLES], pose[N_SAMPLES][POSE_SIZE], rate[N_SAMPLES][6],
      second_rate[N_SAMPLES][6], q[N_SAMPLES][2][MOST_JOINTS], state[2][2][STATE],
      outputs[SAMPLE_SIZE], begin[2][MOST_JOINTS], numbers[N_NUMBERS + 1],
      clearance[N_PAIRS + 1], quaternions[4 * N_PIECES], positions[3 * N_PIECES],
      w[MOST_OF_ALL(W) + 1];
  double direction[N_PAIRS + 1][DUAL_ARM_LANES][3];
  const lanes_real* arg[MOST_OF_ALL(ARG) + 8];
  lanes_real* res[MOST_OF_ALL(RES) + 64];
  lanes_int iw[MOST_OF_ALL(IW) + 1];
} scratch;

/* One per thread, kept as long as the thread. */
static __thread scratch* own;

static double lane_of(const lanes_real* x, int l) { return ((const double*)x)[l]; }

/* Both arms and the load along the samples: violations, states, and what is asked for. */
static int follow(const batch_data* batch, long long first, int m) {
  scratch* s = own;
  lanes_real violation[N_CONSTRAINTS], share[N_CONSTRAINTS], zero = lanes_all_equal(0.0);
  lanes_mask first_sample = (lanes_mask){0} + N_SAMPLES, first_reason = (lanes_mask){0} - 1;
  lanes_mask reached = (lanes_mask){0} + N_SAMPLES;
  for (int c = 0; c < N_CONSTRAINTS; ++c) violation[c] = share[c] = zero;
  const double* from = batch->begin;
  for (int i = 0; i < 2; ++i)
    for (int j = 0; j < N_JOINTS[i]; ++j) s->begin[i][j] = lanes_all_equal(*from++);
  s->arg[0] = s->pose[0];
  for (int i = 0; i < 2; ++i) s->arg[1 + i] = s->begin[i];
  start_GIVEN(3);
  s->res[0] = s->state[0][0];
  s->res[1] = s->state[0][1];
  if (start(s->arg, s->res, s->iw, s->w)) return 1;
  lanes_real total = s->time[N_SAMPLES - 1];
  for (int k = 0; k < N_SAMPLES; ++k) {
    lanes_real(*before)[STATE] = s->state[k % 2], (*after)[STATE] = s->state[1 - k % 2];
    if (k == 1) {
      for (int i = 0; i < 2; ++i) s->arg[i] = before[i];
      s->arg[2] = s->pose[1];
      predict_GIVEN(3);
      for (int i = 0; i < 2; ++i) s->res[i] = after[i];
      if (predict(s->arg, s->res, s->iw, s->w)) return 1;
      memcpy(before, after, sizeof s->state[0]);
    }
    s->arg[0] = s->pose[k];
    s->arg[1] = s->rate[k];
    s->arg[2] = s->second_rate[k];
    for (int i = 0; i < 2; ++i) s->arg[3 + i] = before[i];
    sample_GIVEN(5);
    for (int i = 0; i < 2; ++i) s->res[i] = after[i];
    for (int o = 0; o < N_OUTPUTS; ++o) s->res[AFTER_STATES + o] = s->outputs + OUTPUT_AT[o];
    if (sample(s->arg, s->res, s->iw, s->w)) return 1;
    for (int i = 0; i < 2; ++i)
      memcpy(s->q[k][i], s->outputs + Q_AT[i], N_JOINTS[i] * sizeof(lanes_real));
    lanes_mask lost = (s->outputs[LOST_AT[0]] > zero) | (s->outputs[LOST_AT[1]] > zero);
    lanes_mask now = lost & (reached == N_SAMPLES);
    reached = (now & k) | (~now & reached);
    lanes_real since = k ? s->time[k] - s->time[k - 1] : zero;
    lanes_real until = k + 1 < N_SAMPLES ? s->time[k + 1] - s->time[k] : zero;
    lanes_real part = (since + until) / (2.0 * total);
    const lanes_real* constraint = s->outputs + CONSTRAINT_AT;
    for (int c = 0; c < N_CONSTRAINTS; ++c) {
      lanes_mask violated = constraint[c] > zero;
      violation[c] = lanes_fmax(violation[c], lanes_fmax(constraint[c], zero));
      share[c] += lanes_where(violated, part);
      lanes_mask new = violated & (first_sample == N_SAMPLES);
      first_sample = (new & k) | (~new & first_sample);
      first_reason = (new & c) | (~new & first_reason);
    }
    for (int o = 0; o < N_OUTPUTS; ++o) {
      if (!batch->wanted[o]) continue;
      for (int l = 0; l < m; ++l)
        for (int j = 0; j < OUTPUT_SIZE[o]; ++j)
          batch->wanted[o][((first + l) * N_SAMPLES + k) * OUTPUT_SIZE[o] + j] =
              lane_of(s->outputs + OUTPUT_AT[o] + j, l);
    }
  }
  for (int l = 0; l < m; ++l) {
    long long row = first + l;
    for (int c = 0; c < N_CONSTRAINTS; ++c) {
      batch->violation[row * N_CONSTRAINTS + c] = lane_of(violation + c, l);
      batch->violation_time[row * N_CONSTRAINTS + c] = lane_of(share + c, l);
    }
    for (int k = 0; k < N_SAMPLES; ++k) batch->time[row * N_SAMPLES + k] = lane_of(s->time + k, l);
    batch->first_sample[row] = first_sample[l];
    batch->first_reason[row] = first_reason[l];
    batch->reached[row] = reached[l];
  }
  return 0;
}

#ifdef FORCES_COME_LAST
static double larger(double x, double y) { return x > y || y != y ? x : y; }

/* The forces of the candidate in lane l, several of its samples side by side. */
static int press(const batch_data* batch, long long row, int l) {
  scratch* s = own;
  lanes_real pose[POSE_SIZE], rate[6], second_rate[6], q[2][MOST_JOINTS], found[FORCES_SIZE];
  const double* time = batch->time + row * N_SAMPLES;
  for (int first = 0; first < N_SAMPLES; first += DUAL_ARM_LANES) {
    int m = N_SAMPLES - first < DUAL_ARM_LANES ? N_SAMPLES - first : DUAL_ARM_LANES;
    for (int i = 0; i < DUAL_ARM_LANES; ++i) {
      int k = first + (i < m ? i : m - 1);
      for (int j = 0; j < POSE_SIZE; ++j) pose[j][i] = s->pose[k][j][l];
      for (int j = 0; j < 6; ++j) rate[j][i] = s->rate[k][j][l];
      for (int j = 0; j < 6; ++j) second_rate[j][i] = s->second_rate[k][j][l];
      for (int a = 0; a < 2; ++a)
        for (int j = 0; j < N_JOINTS[a]; ++j) q[a][j][i] = s->q[k][a][j][l];
    }
    s->arg[0] = pose;
    s->arg[1] = rate;
    s->arg[2] = second_rate;
    for (int a = 0; a < 2; ++a) s->arg[3 + a] = q[a];
    forces_GIVEN(5);
    for (int o = 0; o <= N_FORCES; ++o) s->res[o] = found + FORCES_AT[o];
    if (forces(s->arg, s->res, s->iw, s->w)) return 1;
    for (int o = 0; o < N_FORCES; ++o) {
      int output = FORCES_OUTPUT[o], size = OUTPUT_SIZE[output];
      if (!batch->wanted[output]) continue;
      double* into = batch->wanted[output] + (row * N_SAMPLES + first) * size;
      for (int i = 0; i < m; ++i)
        for (int j = 0; j < size; ++j) *into++ = found[FORCES_AT[o] + j][i];
    }
    for (int i = 0; i < m; ++i) {
      int k = first + i;
      double since = k ? time[k] - time[k - 1] : 0.0;
      double until = k + 1 < N_SAMPLES ? time[k + 1] - time[k] : 0.0;
      double part = (since + until) / (2.0 * time[N_SAMPLES - 1]);
      for (int c = 0; c < N_FORCE_CONSTRAINTS; ++c) {
        int column = N_CONSTRAINTS - N_FORCE_CONSTRAINTS + c;
        double value = found[FORCES_AT[N_FORCES] + c][i];
        double* worst = batch->violation + row * N_CONSTRAINTS + column;
        if (batch->wanted[CONSTRAINT_OUTPUT])
          batch->wanted[CONSTRAINT_OUTPUT][(row * N_SAMPLES + k) * N_CONSTRAINTS + column] = value;
        *worst = larger(*worst, larger(value, 0.0));
        if (!(value > 0.0)) continue;
        batch->violation_time[row * N_CONSTRAINTS + column] += part;
        if (k >= batch->first_sample[row]) continue;
        batch->first_sample[row] = k;
        batch->first_reason[row] = column;
      }
    }
  }
  return 0;
}

/* The forces of those candidates of a pass that violate nothing so far, or of all. */
static int press_all(const batch_data* batch, long long first, int m) {
  for (int l = 0; l < m; ++l) {
    const unsigned char* colliding = batch->colliding + (first + l) * N_SAMPLES;
    int wanted = batch->all_forces || (batch->first_sample[first + l] == N_SAMPLES &&
                                       !memchr(colliding, 1, N_SAMPLES));
    if (wanted && press(batch, first + l, l)) return 1;
  }
  return 0;
}
#endif

/* Whether a pair is allowed to touch here; OPEN where rounding could tell otherwise. */
static int rests(const judge_data* judge, long long pair, int k, int l) {
  for (long long i = 0; i < judge->n_resting; ++i) {
    const resting_place* at = judge->resting + i;
    if (at->pair != pair) continue;
    double square = 0.0;
    for (int j = 0; j < 3; ++j) {
      double off = lane_of(own->pose[k] + j, l) - at->place[j];
      square += off * off;
    }
    double beyond = sqrt(square) - at->departure;
    if (!(fabs(beyond) > 1e-9)) return -1;
    if (beyond < 0.0) return 1;
  }
  return 0;
}

static int decide(const judge_data* judge, long long pair, int k, int l) {
  scratch* s = own;
  int resting = rests(judge, pair, k, l);
  if (resting < 0) return OPEN;
  /* A resting payload may come nearer than the tolerance; it only must not intersect. */
  double tolerance = resting ? 0.0 : judge->tolerance[pair];
  const long long* bodies = judge->pairs + 2 * pair;
  return judge->decide(judge->bodies, (const double*)s->quaternions + l,
                       (const double*)s->positions + l, DUAL_ARM_LANES,
                       resting ? judge->shrunk_payload : bodies[0], bodies[1],
                       judge->margin + tolerance, judge->margin - tolerance, s->direction[pair][l]);
}

/* Cell of a table at a joint position [rad], -1 where it is uncertain. */
static long long table_cell(double q) {
  if (!(fabs(q) < TABLE_MOST_ANGLE)) return -1;
  return (long long)floor(q * TABLE_CELLS_PER_RADIAN) & (TABLE_CELLS - 1);
}

/* The lanes among `bits` that the table of a pair leaves open. */
static unsigned not_tabulated_free(const judge_data* judge, long long pair, int k, unsigned bits) {
  const joint_table* table = judge->tables + pair;
  if (!table->bounds) return bits;
  const lanes_real* q = own->q[k][table->robot] + table->joint;
  for (int l = 0; l < DUAL_ARM_LANES; ++l) {
    if (!(bits >> l & 1u)) continue;
    long long first = table_cell(lane_of(q, l)), second = table_cell(lane_of(q + 1, l));
    if (first < 0 || second < 0) continue;
    if (table->bounds[first * TABLE_CELLS + second] > judge->free_beyond[pair]) bits &= ~(1u << l);
  }
  return bits;
}

/* Which samples of the candidates collide, and which pairs are still to be judged. */
static int collide(batch_data* batch, const judge_data* judge, long long first, int m) {
  scratch* s = own;
  memset(s->direction, 0, sizeof s->direction);
  for (int k = 0; k < N_SAMPLES; ++k) {
    unsigned alive = 0, placed_already = 0;
    lanes_real sum = lanes_all_equal(0.0);
    for (int j = 0; j < 6; ++j) sum += s->pose[k][j];
    for (int i = 0; i < 2; ++i)
      for (int j = 0; j < N_JOINTS[i]; ++j) sum += s->q[k][i][j];
    /* What is not finite is no posture; the candidate fails for that. */
    unsigned finite = lanes_bits(lanes_fabs(sum) < lanes_all_equal(INFINITY));
    for (int l = 0; l < m; ++l) alive |= (unsigned)(k < batch->reached[first + l]) << l;
    alive &= finite;
    if (!alive) continue;
    s->arg[0] = s->pose[k];
    for (int i = 0; i < 2; ++i) s->arg[1 + i] = s->q[k][i];
    s->res[0] = s->clearance;
    clearance_GIVEN(3);
    if (clearance(s->arg, s->res, s->iw, s->w)) return 1;
#if N_NEAR < N_PAIRS
    if (judge->has_far) {
      s->res[0] = s->clearance + N_NEAR;
      far_clearance_GIVEN(3);
      if (far_clearance(s->arg, s->res, s->iw, s->w)) return 1;
    }
#endif
    unsigned colliding = 0;
    long long kept = batch->n_open;
    for (long long pair = 0; pair < judge->n_pairs; ++pair) {
      /* Not above: a bound that is not a number stays open. */
      lanes_mask free = s->clearance[judge->columns[pair]] > lanes_all_equal(judge->free_beyond[pair]);
      unsigned bits = ~lanes_bits(free) & alive & ~colliding;
      if (__builtin_expect(!bits, 1)) continue;
      bits = not_tabulated_free(judge, pair, k, bits);
      if (!bits) continue;
      if (!placed_already) {
        s->arg[0] = s->pose[k];
        for (int i = 0; i < 2; ++i) s->arg[1 + i] = s->q[k][i];
        piece_poses_GIVEN(3);
        s->res[0] = s->quaternions;
        s->res[1] = s->positions;
        if (piece_poses(s->arg, s->res, s->iw, s->w)) return 1;
        placed_already = 1;
      }
      for (int l = 0; l < m; ++l) {
        if (!(bits >> l & 1u)) continue;
        int found = decide(judge, pair, k, l);
        if (found == INTERSECTING) colliding |= 1u << l;
        if (found != OPEN) continue;
        open_pair* one = batch->open + batch->n_open++;
        one->candidate = first + l;
        one->sample = k;
        one->pair = pair;
        double* into = one->configuration;
        for (int j = 0; j < 6; ++j) *into++ = lane_of(s->pose[k] + j, l);
        for (int i = 0; i < 2; ++i)
          for (int j = 0; j < N_JOINTS[i]; ++j) *into++ = lane_of(s->q[k][i] + j, l);
      }
    }
    /* A sample that collides has no more to be judged. */
    for (long long i = kept; i < batch->n_open; ++i) {
      open_pair* one = batch->open + i;
      if (!(colliding >> (one->candidate - first) & 1u)) batch->open[kept++] = *one;
    }
    batch->n_open = kept;
    for (int l = 0; l < m; ++l)
      batch->colliding[(first + l) * N_SAMPLES + k] = colliding >> l & 1u;
  }
  return 0;
}

/* Evaluate candidates from `from` on. Returns the candidate to go on with once the open pairs are
   taken, n at the end, or -1 where memory is short or a function failed. */
DUAL_ARM_EXPORT long long dual_arm_evaluate(batch_data* batch, const judge_data* judge,
                                            long long from) {
  if (!own) {
    own = aligned_alloc(64, (sizeof(scratch) + 63) / 64 * 64);
    if (!own) return -1;
  }
  scratch* s = own;
  batch->n_open = 0;
  for (int j = 0; j < N_NUMBERS; ++j) s->numbers[j] = lanes_all_equal(batch->numbers[j]);
  for (long long first = from; first < batch->n; first += DUAL_ARM_LANES) {
    if (batch->room - batch->n_open < DUAL_ARM_LANES * (long long)N_SAMPLES * N_PAIRS)
      return first;
    int m = batch->n - first < DUAL_ARM_LANES ? (int)(batch->n - first) : DUAL_ARM_LANES;
    for (int j = 0; j < N_VAR; ++j)
      for (int l = 0; l < DUAL_ARM_LANES; ++l)
        ((double*)(s->x + j))[l] = batch->x[(first + (l < m ? l : m - 1)) * N_VAR + j];
    s->arg[0] = s->x;
    path_GIVEN(1);
    s->res[0] = s->time;
    s->res[1] = s->pose[0];
    s->res[2] = s->rate[0];
    s->res[3] = s->second_rate[0];
    if (path(s->arg, s->res, s->iw, s->w) || follow(batch, first, m)) return -1;
    if (batch->with_collisions && collide(batch, judge, first, m)) return -1;
#ifdef FORCES_COME_LAST
    if (press_all(batch, first, m)) return -1;
#endif
  }
  return batch->n;
}
