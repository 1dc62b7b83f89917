/* Sine and cosine of one number, with the bits of those in lanes (see sincos.h). */
#define SINCOS_REACH 1e5

static inline long long dual_arm_bits(double x) {
  long long bits;
  __builtin_memcpy(&bits, &x, sizeof bits);
  return bits;
}

#define REAL double
#define INTEGER long long
#define NAME(function) dual_arm_##function
#define BITS(x) dual_arm_bits(x)
#define CONDITION(q) ((q) != 0)
#define SELECT(condition, a, b) ((condition) ? (a) : (b))
#define FLIP(x, q) ((q) ? -(x) : (x))
#include "sincos.h"
#undef REAL
#undef INTEGER
#undef NAME
#undef BITS
#undef CONDITION
#undef SELECT
#undef FLIP

static inline double dual_arm_sin(double x) {
  return x <= SINCOS_REACH && x >= -SINCOS_REACH ? dual_arm_sin_within_reach(x) : sin(x);
}

static inline double dual_arm_cos(double x) {
  return x <= SINCOS_REACH && x >= -SINCOS_REACH ? dual_arm_cos_within_reach(x) : cos(x);
}

#define sin dual_arm_sin
#define cos dual_arm_cos
