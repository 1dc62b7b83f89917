/* The maximum and minimum of C, where a NaN gives way to the other argument, as expressions:
   the library's own are calls that compilers do not inline. */
static inline double dual_arm_fmax(double x, double y) { return x > y || y != y ? x : y; }
static inline double dual_arm_fmin(double x, double y) { return x < y || y != y ? x : y; }
#define fmax dual_arm_fmax
#define fmin dual_arm_fmin
