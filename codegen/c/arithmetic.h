/* The maximum and minimum of C, where a NaN gives way to the other argument, as expressions without
   a branch: the library's own are calls that compilers do not inline. */
static inline double dual_arm_fmax(double x, double y) {
  double larger = x > y ? x : y;
  return y != y ? x : larger;
}
static inline double dual_arm_fmin(double x, double y) {
  double smaller = x < y ? x : y;
  return y != y ? x : smaller;
}
#define fmax dual_arm_fmax
#define fmin dual_arm_fmin
