/* What all C of the polish begins with. */

#include <math.h>
#include <string.h>

#define OFFERED __attribute__((visibility("default")))

typedef long long integer;

enum { VECTOR = 8 };

static integer whole_vectors(integer n) { return (n + VECTOR - 1) / VECTOR * VECTOR; }

/* to += by what; n is a multiple of VECTOR. */
static void add_wide(double *restrict to, double by, const double *restrict what, integer n) {
  for (integer i = 0; i < n; i += VECTOR)
    for (int j = 0; j < VECTOR; j++) to[i + j] += by * what[i + j];
}
