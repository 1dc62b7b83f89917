#if defined(__GNUC__)
#define DUAL_ARM_EXPORT __attribute__((visibility("default")))
#else
#define DUAL_ARM_EXPORT
#endif

/* An argument or result: its first candidate, and the step to the next in doubles. */
typedef struct { casadi_real* base; long long step; } dual_arm_port;

/* Work memory of one thread. */
typedef struct {
  const casadi_real** arg; casadi_real** res; casadi_int* iw; casadi_real* w;
} dual_arm_work;

#if @STATE@
/* Solvers in generated code keep their state in one place, without a guard: one call at a time. */
#include <sched.h>
static volatile int dual_arm_lock = 0;
static void dual_arm_acquire(void) {
  while (__sync_lock_test_and_set(&dual_arm_lock, 1)) sched_yield();
}
static void dual_arm_free(void) { __sync_lock_release(&dual_arm_lock); }
#else
static void dual_arm_acquire(void) {}
static void dual_arm_free(void) {}
#endif

DUAL_ARM_EXPORT void dual_arm_load(void) { @NAME@_incref(); }

DUAL_ARM_EXPORT void dual_arm_sizes(long long* sizes) {
  casadi_int arg, res, iw, w;
  @NAME@_work(&arg, &res, &iw, &w);
  sizes[0] = arg; sizes[1] = res; sizes[2] = iw; sizes[3] = w;
}

/* Evaluate candidates begin to end. Returns -1, or the first candidate that failed. */
DUAL_ARM_EXPORT long long dual_arm_run(const dual_arm_port* ports, const dual_arm_work* work,
                                       long long begin, long long end) {
  const dual_arm_port* results = ports + @N_IN@;
  long long failed = -1, k;
  int mem, i;
  dual_arm_acquire();
  mem = @NAME@_checkout();
  for (k = begin; k < end; ++k) {
    for (i = 0; i < @N_IN@; ++i)
      work->arg[i] = ports[i].base ? ports[i].base + k * ports[i].step : 0;
    for (i = 0; i < @N_OUT@; ++i)
      work->res[i] = results[i].base ? results[i].base + k * results[i].step : 0;
    if (@NAME@(work->arg, work->res, work->iw, work->w, mem)) { failed = k; break; }
  }
  @NAME@_release(mem);
  dual_arm_free();
  return failed;
}
