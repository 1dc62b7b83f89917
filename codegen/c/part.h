/* What the statements of a CasADi function use, where it stands in a file of its own. */
typedef double casadi_real;
typedef long long int casadi_int;
#define casadi_inf INFINITY
static inline casadi_real casadi_sq(casadi_real x) { return x * x; }
static inline casadi_real casadi_fmax(casadi_real x, casadi_real y) { return fmax(x, y); }
static inline casadi_real casadi_fmin(casadi_real x, casadi_real y) { return fmin(x, y); }
static inline casadi_real casadi_fabs(casadi_real x) { return fabs(x); }
static inline casadi_real casadi_sign(casadi_real x) { return x < 0 ? -1 : x > 0 ? 1 : x; }
