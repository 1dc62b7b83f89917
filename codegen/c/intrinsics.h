/* The intrinsics that lanes.h uses. Where the compiler has the functions behind them as GCC has, they
   are named here: to read all of immintrin.h takes GCC 0.15 s, for each of a hundred files. */
#if defined(__has_builtin)
#if DUAL_ARM_LANES == 8 && defined(__AVX512F__)
#if __has_builtin(__builtin_ia32_maxpd512_mask) && __has_builtin(__builtin_ia32_minpd512_mask) && \
    __has_builtin(__builtin_ia32_cmppd512_mask) && __has_builtin(__builtin_ia32_ptestmq512) && \
    __has_builtin(__builtin_ia32_sqrtpd512_mask) && __has_builtin(__builtin_ia32_rndscalepd_mask)
#define LANES_INTRINSICS
typedef double __m512d __attribute__((vector_size(64), may_alias));
typedef long long __m512i __attribute__((vector_size(64), may_alias));
#define _CMP_ORD_Q 7
#define _MM_FROUND_TO_NEG_INF 1
#define _MM_FROUND_TO_POS_INF 2
#define _MM_FROUND_CUR_DIRECTION 4
#define _MM_FROUND_NO_EXC 8
#define _mm512_mask_max_pd(w, u, a, b) __builtin_ia32_maxpd512_mask(a, b, w, u, 4)
#define _mm512_mask_min_pd(w, u, a, b) __builtin_ia32_minpd512_mask(a, b, w, u, 4)
#define _mm512_cmp_pd_mask(a, b, how) __builtin_ia32_cmppd512_mask(a, b, how, (unsigned char)-1, 4)
#define _mm512_test_epi64_mask(a, b) \
  ((unsigned char)__builtin_ia32_ptestmq512(a, b, (unsigned char)-1))
#define _mm512_sqrt_pd(a) __builtin_ia32_sqrtpd512_mask(a, a, (unsigned char)-1, 4)
#define _mm512_roundscale_pd(a, how) \
  __builtin_ia32_rndscalepd_mask(a, how, a, (unsigned char)-1, 4)
#endif
#elif DUAL_ARM_LANES == 4 && defined(__AVX__)
#if __has_builtin(__builtin_ia32_maxpd256) && __has_builtin(__builtin_ia32_minpd256) && \
    __has_builtin(__builtin_ia32_cmppd256) && __has_builtin(__builtin_ia32_blendvpd256) && \
    __has_builtin(__builtin_ia32_movmskpd256) && __has_builtin(__builtin_ia32_sqrtpd256) && \
    __has_builtin(__builtin_ia32_roundpd256)
#define LANES_INTRINSICS
typedef double __m256d __attribute__((vector_size(32), may_alias));
#define _CMP_UNORD_Q 3
#define _mm256_max_pd(a, b) __builtin_ia32_maxpd256(a, b)
#define _mm256_min_pd(a, b) __builtin_ia32_minpd256(a, b)
#define _mm256_cmp_pd(a, b, how) __builtin_ia32_cmppd256(a, b, how)
#define _mm256_blendv_pd(a, b, mask) __builtin_ia32_blendvpd256(a, b, mask)
#define _mm256_movemask_pd(a) __builtin_ia32_movmskpd256(a)
#define _mm256_sqrt_pd(a) __builtin_ia32_sqrtpd256(a)
#define _mm256_floor_pd(a) __builtin_ia32_roundpd256(a, 9)
#define _mm256_ceil_pd(a) __builtin_ia32_roundpd256(a, 10)
#endif
#endif
#endif

#if !defined(LANES_INTRINSICS) && defined(__SSE2__)
#include <immintrin.h>
#elif !defined(LANES_INTRINSICS) && defined(__aarch64__)
#include <arm_neon.h>
#endif
