/* Numbers in lanes: one evaluation in each. The width is the machine's, or DUAL_ARM_LANES if that
   is defined; 1 stands for none. Each operation gives in every lane the bits that C gives for one
   number, so results do not depend on the width. */
#ifndef DUAL_ARM_LANES
#if !defined(__GNUC__)
#define DUAL_ARM_LANES 1
#elif defined(__AVX512F__)
#define DUAL_ARM_LANES 8
#elif defined(__AVX2__)
#define DUAL_ARM_LANES 4
#elif defined(__SSE2__) || defined(__aarch64__)
#define DUAL_ARM_LANES 2
#else
#define DUAL_ARM_LANES 1
#endif
#endif

#if DUAL_ARM_LANES > 1

#include "intrinsics.h"

typedef double lanes_real __attribute__((vector_size(8 * DUAL_ARM_LANES)));
typedef long long lanes_mask __attribute__((vector_size(8 * DUAL_ARM_LANES)));
typedef long long lanes_int;

#define LANES_INLINE static inline __attribute__((always_inline))
#define LANES_COLD static __attribute__((noinline, cold))

LANES_INLINE lanes_real lanes_all_equal(double x) { return (lanes_real){0} + x; }

/* Entry k of an argument that is the same in all lanes: not lanes but numbers, which take a fraction
   of the memory. */
LANES_INLINE lanes_real lanes_shared(const lanes_real* numbers, int k) {
  return lanes_all_equal(((const double*)numbers)[k]);
}

#if DUAL_ARM_LANES == 8
#define LANES_CONSTANT(x) {x, x, x, x, x, x, x, x}
#elif DUAL_ARM_LANES == 4
#define LANES_CONSTANT(x) {x, x, x, x}
#else
#define LANES_CONSTANT(x) {x, x}
#endif

/* Masks have all bits of a lane set, or none. */
LANES_INLINE lanes_real lanes_blend(lanes_mask m, lanes_real a, lanes_real b) {
  return (lanes_real)((m & (lanes_mask)a) | (~m & (lanes_mask)b));
}
LANES_INLINE lanes_real lanes_where(lanes_mask m, lanes_real a) {
  return (lanes_real)(m & (lanes_mask)a);
}

/* One bit per lane, the first lane's lowest. */
LANES_INLINE unsigned lanes_bits(lanes_mask m) {
#if DUAL_ARM_LANES == 8 && defined(__AVX512F__)
  return _mm512_test_epi64_mask((__m512i)m, (__m512i)m);
#elif DUAL_ARM_LANES == 4 && defined(__AVX__)
  return (unsigned)_mm256_movemask_pd((__m256d)m);
#elif DUAL_ARM_LANES == 2 && defined(__SSE2__)
  return (unsigned)_mm_movemask_pd((__m128d)m);
#else
  unsigned bits = 0;
  for (int l = 0; l < DUAL_ARM_LANES; ++l) bits |= (unsigned)(m[l] != 0) << l;
  return bits;
#endif
}
#define LANES_FULL ((1u << DUAL_ARM_LANES) - 1u)

/* C's comparisons and logic, whose results are 0 and 1. */
LANES_INLINE lanes_mask lanes_true(lanes_real a) { return a != lanes_all_equal(0.0); }
LANES_INLINE lanes_real lanes_truth(lanes_mask m) { return lanes_where(m, lanes_all_equal(1.0)); }
LANES_INLINE lanes_real lanes_lt(lanes_real a, lanes_real b) { return lanes_truth(a < b); }
LANES_INLINE lanes_real lanes_le(lanes_real a, lanes_real b) { return lanes_truth(a <= b); }
LANES_INLINE lanes_real lanes_eq(lanes_real a, lanes_real b) { return lanes_truth(a == b); }
LANES_INLINE lanes_real lanes_ne(lanes_real a, lanes_real b) { return lanes_truth(a != b); }
LANES_INLINE lanes_real lanes_not(lanes_real a) { return lanes_truth(~lanes_true(a)); }
LANES_INLINE lanes_real lanes_and(lanes_real a, lanes_real b) {
  return lanes_truth(lanes_true(a) & lanes_true(b));
}
LANES_INLINE lanes_real lanes_or(lanes_real a, lanes_real b) {
  return lanes_truth(lanes_true(a) | lanes_true(b));
}
LANES_INLINE lanes_real lanes_if(lanes_real condition, lanes_real a) {
  return lanes_where(lanes_true(condition), a);
}

LANES_INLINE lanes_real lanes_fmax(lanes_real x, lanes_real y) {
#if DUAL_ARM_LANES == 8 && defined(__AVX512F__)
  __m512d a = (__m512d)x, b = (__m512d)y;
  return (lanes_real)_mm512_mask_max_pd(a, _mm512_cmp_pd_mask(b, b, _CMP_ORD_Q), a, b);
#elif DUAL_ARM_LANES == 4 && defined(__AVX__)
  __m256d a = (__m256d)x, b = (__m256d)y;
  return (lanes_real)_mm256_blendv_pd(_mm256_max_pd(a, b), a, _mm256_cmp_pd(b, b, _CMP_UNORD_Q));
#elif DUAL_ARM_LANES == 2 && defined(__SSE2__)
  return lanes_blend((lanes_mask)(y != y), x, (lanes_real)_mm_max_pd((__m128d)x, (__m128d)y));
#else
  return lanes_blend((x > y) | (y != y), x, y);
#endif
}
LANES_INLINE lanes_real lanes_fmin(lanes_real x, lanes_real y) {
#if DUAL_ARM_LANES == 8 && defined(__AVX512F__)
  __m512d a = (__m512d)x, b = (__m512d)y;
  return (lanes_real)_mm512_mask_min_pd(a, _mm512_cmp_pd_mask(b, b, _CMP_ORD_Q), a, b);
#elif DUAL_ARM_LANES == 4 && defined(__AVX__)
  __m256d a = (__m256d)x, b = (__m256d)y;
  return (lanes_real)_mm256_blendv_pd(_mm256_min_pd(a, b), a, _mm256_cmp_pd(b, b, _CMP_UNORD_Q));
#elif DUAL_ARM_LANES == 2 && defined(__SSE2__)
  return lanes_blend((lanes_mask)(y != y), x, (lanes_real)_mm_min_pd((__m128d)x, (__m128d)y));
#else
  return lanes_blend((x < y) | (y != y), x, y);
#endif
}
LANES_INLINE lanes_real lanes_fabs(lanes_real x) {
  return (lanes_real)((lanes_mask)x & 0x7fffffffffffffffLL);
}
LANES_INLINE lanes_real lanes_sign(lanes_real x) {
  lanes_real zero = lanes_all_equal(0.0);
  lanes_real up = lanes_blend(x > zero, lanes_all_equal(1.0), x);
  return lanes_blend(x < zero, lanes_all_equal(-1.0), up);
}
LANES_INLINE lanes_real lanes_sq(lanes_real x) { return x * x; }
LANES_INLINE lanes_real lanes_sqrt(lanes_real x) {
#if DUAL_ARM_LANES == 8 && defined(__AVX512F__)
  return (lanes_real)_mm512_sqrt_pd((__m512d)x);
#elif DUAL_ARM_LANES == 4 && defined(__AVX__)
  return (lanes_real)_mm256_sqrt_pd((__m256d)x);
#elif DUAL_ARM_LANES == 2 && defined(__SSE2__)
  return (lanes_real)_mm_sqrt_pd((__m128d)x);
#elif DUAL_ARM_LANES == 2 && defined(__aarch64__)
  return (lanes_real)vsqrtq_f64((float64x2_t)x);
#else
  lanes_real y;
  for (int l = 0; l < DUAL_ARM_LANES; ++l) y[l] = __builtin_sqrt(x[l]);
  return y;
#endif
}

/* What has no form in lanes of its own, one lane after the other. */
#define LANES_EACH(f)                                                   \
  LANES_COLD lanes_real lanes_##f(lanes_real x) {                       \
    lanes_real y;                                                       \
    for (int l = 0; l < DUAL_ARM_LANES; ++l) y[l] = __builtin_##f(x[l]); \
    return y;                                                           \
  }
#define LANES_EACH_2(f)                                                       \
  LANES_COLD lanes_real lanes_##f(lanes_real x, lanes_real y) {               \
    lanes_real z;                                                             \
    for (int l = 0; l < DUAL_ARM_LANES; ++l) z[l] = __builtin_##f(x[l], y[l]); \
    return z;                                                                 \
  }
LANES_EACH(exp) LANES_EACH(log) LANES_EACH(tan) LANES_EACH(asin) LANES_EACH(acos) LANES_EACH(atan)
LANES_EACH(sinh) LANES_EACH(cosh) LANES_EACH(tanh) LANES_EACH_2(pow) LANES_EACH_2(atan2)
LANES_EACH_2(hypot) LANES_EACH_2(fmod)

/* Angles are unwrapped with these: one lane after the other they take longer than all the rest. */
#if DUAL_ARM_LANES == 8 && defined(__AVX512F__)
#define LANES_ROUND(f, direction)                                                \
  LANES_INLINE lanes_real lanes_##f(lanes_real x) {                              \
    return (lanes_real)_mm512_roundscale_pd((__m512d)x, direction | _MM_FROUND_NO_EXC); \
  }
LANES_ROUND(ceil, _MM_FROUND_TO_POS_INF)
LANES_ROUND(floor, _MM_FROUND_TO_NEG_INF)
#elif DUAL_ARM_LANES == 4 && defined(__AVX__)
#define LANES_ROUND(f) \
  LANES_INLINE lanes_real lanes_##f(lanes_real x) { return (lanes_real)_mm256_##f##_pd((__m256d)x); }
LANES_ROUND(ceil)
LANES_ROUND(floor)
#elif DUAL_ARM_LANES == 2 && defined(__SSE4_1__)
#define LANES_ROUND(f) \
  LANES_INLINE lanes_real lanes_##f(lanes_real x) { return (lanes_real)_mm_##f##_pd((__m128d)x); }
LANES_ROUND(ceil)
LANES_ROUND(floor)
#elif DUAL_ARM_LANES == 2 && defined(__aarch64__)
LANES_INLINE lanes_real lanes_ceil(lanes_real x) { return (lanes_real)vrndpq_f64((float64x2_t)x); }
LANES_INLINE lanes_real lanes_floor(lanes_real x) { return (lanes_real)vrndmq_f64((float64x2_t)x); }
#else
LANES_EACH(ceil) LANES_EACH(floor)
#endif

#define REAL lanes_real
#define INTEGER lanes_mask
#define NAME(function) lanes_##function
#define BITS(x) ((lanes_mask)(x))
#define CONDITION(q) ((q) != 0)
#define SELECT(condition, a, b) lanes_blend((condition), (a), (b))
#define FLIP(x, q) ((lanes_real)((lanes_mask)(x) ^ ((q) << 62)))
#include "sincos.h"
#undef REAL
#undef INTEGER
#undef NAME
#undef BITS
#undef CONDITION
#undef SELECT
#undef FLIP

LANES_COLD lanes_real lanes_sin_of_large(lanes_real x) {
  lanes_real y;
  for (int l = 0; l < DUAL_ARM_LANES; ++l) y[l] = dual_arm_sin(x[l]);
  return y;
}
LANES_COLD lanes_real lanes_cos_of_large(lanes_real x) {
  lanes_real y;
  for (int l = 0; l < DUAL_ARM_LANES; ++l) y[l] = dual_arm_cos(x[l]);
  return y;
}
LANES_INLINE unsigned lanes_beyond_reach(lanes_real x) {
  return lanes_bits(~(lanes_fabs(x) <= lanes_all_equal(SINCOS_REACH)));
}
LANES_INLINE lanes_real lanes_sin(lanes_real x) {
  lanes_real y = lanes_sin_within_reach(x);
  return __builtin_expect(lanes_beyond_reach(x), 0) ? lanes_sin_of_large(x) : y;
}
LANES_INLINE lanes_real lanes_cos(lanes_real x) {
  lanes_real y = lanes_cos_within_reach(x);
  return __builtin_expect(lanes_beyond_reach(x), 0) ? lanes_cos_of_large(x) : y;
}

/* CasADi's helpers on arrays. */
static inline void lanes_copy(const lanes_real* x, lanes_int n, lanes_real* y) {
  if (!y) return;
  for (lanes_int i = 0; i < n; ++i) y[i] = x ? x[i] : lanes_all_equal(0.0);
}
static inline void lanes_fill(lanes_real* x, lanes_int n, double alpha) {
  if (x)
    for (lanes_int i = 0; i < n; ++i) x[i] = lanes_all_equal(alpha);
}
static inline void lanes_clear(lanes_real* x, lanes_int n) { lanes_fill(x, n, 0.0); }
static inline void lanes_mtimes_dense(const lanes_real* x, lanes_int nrow_x, lanes_int ncol_x,
                                      const lanes_real* y, lanes_int ncol_y, lanes_real* z,
                                      lanes_int transposed) {
  for (lanes_int i = 0; i < ncol_y; ++i)
    if (transposed)
      for (lanes_int j = 0; j < ncol_x; ++j)
        for (lanes_int k = 0; k < nrow_x; ++k)
          z[j + i * ncol_x] += x[k + j * nrow_x] * y[k + i * nrow_x];
    else
      for (lanes_int j = 0; j < nrow_x; ++j)
        for (lanes_int k = 0; k < ncol_x; ++k)
          z[j + i * nrow_x] += x[j + k * nrow_x] * y[k + i * ncol_x];
}
static inline lanes_real lanes_vfmax(const lanes_real* x, lanes_int n, lanes_real r) {
  for (lanes_int i = 0; i < n; ++i) r = lanes_fmax(r, x[i]);
  return r;
}
static inline lanes_real lanes_vfmin(const lanes_real* x, lanes_int n, lanes_real r) {
  for (lanes_int i = 0; i < n; ++i) r = lanes_fmin(r, x[i]);
  return r;
}
static inline lanes_real lanes_mmax(const lanes_real* x, lanes_int n, lanes_int is_dense) {
  lanes_real r = lanes_all_equal(is_dense ? -INFINITY : 0.0);
  return x ? lanes_vfmax(x, n, r) : r;
}
static inline lanes_real lanes_mmin(const lanes_real* x, lanes_int n, lanes_int is_dense) {
  lanes_real r = lanes_all_equal(is_dense ? INFINITY : 0.0);
  return x ? lanes_vfmin(x, n, r) : r;
}
static inline lanes_real lanes_dot(lanes_int n, const lanes_real* x, const lanes_real* y) {
  lanes_real r = lanes_all_equal(0.0);
  for (lanes_int i = 0; i < n; ++i) r += x[i] * y[i];
  return r;
}
static inline lanes_real lanes_norm_2(lanes_int n, const lanes_real* x) {
  return lanes_sqrt(lanes_dot(n, x, x));
}
static inline lanes_real lanes_norm_inf(lanes_int n, const lanes_real* x) {
  lanes_real r = lanes_all_equal(0.0);
  for (lanes_int i = 0; i < n; ++i) r = lanes_fmax(r, lanes_fabs(x[i]));
  return r;
}

/* Results a in the lanes of a mask. */
static inline void lanes_merge(unsigned bits, const lanes_real* a, lanes_int n, lanes_real* b) {
  lanes_mask m;
  for (int l = 0; l < DUAL_ARM_LANES; ++l) m[l] = -(long long)(bits >> l & 1u);
  if (b)
    for (lanes_int i = 0; i < n; ++i) b[i] = lanes_blend(m, a[i], b[i]);
}

#endif
