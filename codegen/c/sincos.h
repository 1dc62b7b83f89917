/* Sine and cosine that give the same bits on every machine and for any number of lanes.

   To be included once per kind of number, with REAL, INTEGER and NAME(function) defined, and with
   BITS(real), SELECT(condition, a, b), CONDITION(integer) and FLIP(real, integer) for them.

   Polynomials of fdlibm (k_sin.c, k_cos.c) behind a reduction by pi/2 in three parts of 33 bits
   (Cody and Waite): products with a quotient below 2^20 are exact. Within one unit in the last
   place for arguments up to SINCOS_REACH; the caller takes the C library's beyond. */

static inline __attribute__((always_inline)) void NAME(parts)(REAL x, REAL* sine, REAL* cosine,
                                                              INTEGER* quadrant) {
  const double magic = 6755399441055744.0; /* 1.5 * 2^52: adding it rounds to an integer */
  REAL shifted = x * 6.36619772367581382433e-01 + magic;
  REAL n = shifted - magic;
  REAL first = x - n * 1.57079632673412561417e+00;
  REAL second_part = n * 6.07710050630396597660e-11;
  REAL second = first - second_part;
  REAL lost = (first - second) - second_part;
  REAL third_part = n * 2.02226624879595063154e-21;
  REAL y = second + (lost - third_part);
  REAL tail = (second - y) + (lost - third_part);
  REAL z = y * y;
  REAL w = z * z;
  REAL v = z * y;
  REAL s = 8.33333333332248946124e-03 +
           z * (-1.98412698298579493134e-04 + z * 2.75573137070700676789e-06) +
           z * w * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10);
  REAL c = z * (4.16666666666666019037e-02 +
                z * (-1.38888888888741095749e-03 + z * 2.48015872894767294178e-05)) +
           w * w * (-2.75573143513906633035e-07 +
                    z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11));
  REAL half = 0.5 * z;
  REAL rest = 1.0 - half;
  *quadrant = BITS(shifted);
  *sine = y - ((z * (0.5 * tail - v * s) - tail) - v * -1.66666666666666324348e-01);
  *cosine = rest + (((1.0 - rest) - half) + (z * c - y * tail));
}

static inline __attribute__((always_inline)) REAL NAME(sin_within_reach)(REAL x) {
  REAL s, c;
  INTEGER q;
  NAME(parts)(x, &s, &c, &q);
  return FLIP(SELECT(CONDITION(q & 1), c, s), q & 2);
}

static inline __attribute__((always_inline)) REAL NAME(cos_within_reach)(REAL x) {
  REAL s, c;
  INTEGER q;
  NAME(parts)(x, &s, &c, &q);
  return FLIP(SELECT(CONDITION(q & 1), s, c), (q + 1) & 2);
}
