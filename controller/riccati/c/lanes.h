/* Several stages at once: the type `lanes` holds one double of each of LANES stages.
 *
 * Vector extensions of GCC and Clang, so that one source serves AVX2 (4), SSE2 and 64-bit NEON (2) and everything else (1: a plain
 * double and libm). LANES can be given; the default is what the target has.
 *
 * Sine and cosine: reduction to |r| <= pi/4 by three parts of pi/2 (Cody and Waite), then the kernels of fdlibm; 1 ulp for small
 * angles, 2e-16 absolute up to 1e4 rad. Arc tangent: kernel of fdlibm below 7/16, the rational function of Cephes above; 1 ulp.
 * Rounding by adding 1.5 * 2^52 needs IEEE arithmetic: -ffast-math would remove it.
 */
#pragma once

#include <math.h>
#include <stdint.h>

#ifdef __FAST_MATH__
#error "compile without -ffast-math: rounding and the tests for NaN rely on IEEE arithmetic"
#endif

#ifndef LANES
#if defined(__AVX2__)
#define LANES 4
#elif defined(__SSE2__) || defined(__aarch64__)
#define LANES 2
#else
#define LANES 1
#endif
#endif

#if LANES == 1

typedef double lanes;
typedef int lane_bits;

static inline lanes lanes_of(double x) { return x; }
static inline lanes lanes_select(lane_bits mask, lanes when_true, lanes when_false) { return mask ? when_true : when_false; }
static inline lanes lanes_abs(lanes x) { return fabs(x); }
static inline double lanes_largest(lanes x) { return x; }
static inline lanes lanes_sqrt(lanes x) { return sqrt(x); }
static inline lanes lanes_atan(lanes x) { return atan(x); }
static inline void lanes_sincos(lanes x, lanes *sine, lanes *cosine)
{
    *sine = sin(x);
    *cosine = cos(x);
}

#else

typedef double lanes __attribute__((vector_size(8 * LANES), may_alias));
typedef int64_t lane_bits __attribute__((vector_size(8 * LANES)));

/* A vector plus a scalar is a vector in C; this makes one of either. */
#define lanes_of(x) ((x) + (lanes){0})

static inline lanes lanes_select(lane_bits mask, lanes when_true, lanes when_false)
{
    return (lanes)((mask & (lane_bits)when_true) | (~mask & (lane_bits)when_false));
}

static inline lanes lanes_abs(lanes x) { return (lanes)((lane_bits)x & INT64_MAX); }

static inline double lanes_largest(lanes x)
{
    double largest = x[0];
    for (int i = 1; i < LANES; i++) largest = x[i] > largest ? x[i] : largest;
    return largest;
}

static inline lanes lanes_sqrt(lanes x)
{
    lanes root;
    for (int i = 0; i < LANES; i++) root[i] = sqrt(x[i]);
    return root;
}

static inline void lanes_sincos(lanes x, lanes *sine, lanes *cosine)
{
    const double rounder = 6755399441055744.0; /* 1.5 * 2^52: the sum has no room for a fraction, and ends in the integer's bits */
    const lanes shifted = x * 0.63661977236758134308 + rounder;
    const lane_bits quadrant = (lane_bits)shifted;
    const lanes n = shifted - rounder;
    const lanes r = x - n * 1.57079632673412561417 - n * 6.07710050630396597660e-11 - n * 2.02226624879595063154e-21;
    const lanes z = r * r;
    const lanes s = r + r * z * (-1.66666666666666324348e-01 + z * (8.33333333332248946124e-03
        + z * (-1.98412698298579493134e-04 + z * (2.75573137070700676789e-06
        + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)))));
    const lanes c = 1.0 - (0.5 * z - z * z * (4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03
        + z * (2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07
        + z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11))))));
    const lane_bits is_odd = (quadrant & 1) != 0;
    const lane_bits sine_sign = (quadrant & 2) << 62, cosine_sign = ((quadrant + 1) & 2) << 62;
    *sine = (lanes)((lane_bits)lanes_select(is_odd, c, s) ^ sine_sign);
    *cosine = (lanes)((lane_bits)lanes_select(is_odd, s, c) ^ cosine_sign);
}

/* Any argument; slower, and needed only for slip angles above 23 degrees. */
static __attribute__((noinline, cold)) lanes lanes_atan_large(lanes x, lanes magnitude)
{
    const lane_bits is_large = magnitude > 2.41421356237309504880, is_medium = magnitude > 0.66;
    const lanes zero = lanes_of(0.0), one = lanes_of(1.0);
    const lanes numerator = lanes_select(is_large, -one, lanes_select(is_medium, magnitude - 1.0, magnitude));
    const lanes denominator = lanes_select(is_large, magnitude, lanes_select(is_medium, magnitude + 1.0, one));
    const lanes start = lanes_select(is_large, lanes_of(1.57079632679489661923),
                                     lanes_select(is_medium, lanes_of(0.78539816339744830962), zero));
    const lanes start_rest = lanes_select(is_large, lanes_of(6.123233995736765886130e-17),
                                          lanes_select(is_medium, lanes_of(3.061616997868382943065e-17), zero));
    const lanes t = numerator / denominator, z = t * t;
    const lanes p = (((-8.750608600031904122785e-1 * z - 1.615753718733365076637e1) * z - 7.500855792314704667340e1) * z
        - 1.228866684490136173410e2) * z - 6.485021904942025371773e1;
    const lanes q = ((((z + 2.485846490142306297962e1) * z + 1.650270098316988542046e2) * z + 4.328810604912902668951e2) * z
        + 4.853903996359136964868e2) * z + 1.945506571482613964425e2;
    const lanes result = start + (t * (z * p / q) + t + start_rest);
    return lanes_select(x < 0.0, -result, result);
}

static inline lanes lanes_atan(lanes x)
{
    const lanes magnitude = lanes_abs(x);
    const lane_bits is_small = magnitude < 0.4375;
    int64_t all_small = -1;
    for (int i = 0; i < LANES; i++) all_small &= is_small[i];
    if (__builtin_expect(!all_small, 0)) return lanes_atan_large(x, magnitude);
    const lanes z = x * x, w = z * z;
    const lanes odd = z * (3.33333333333329318027e-01 + w * (1.42857142725034663711e-01 + w * (9.09088713343650656196e-02
        + w * (6.66107313738753120669e-02 + w * (4.97687799461593236017e-02 + w * 1.62858201153657823623e-02)))));
    const lanes even = w * (-1.99999999998764832476e-01 + w * (-1.11111104054623557880e-01 + w * (-7.69187620504482999495e-02
        + w * (-5.83357013379057348645e-02 + w * -3.65315727442169155270e-02))));
    return x - x * (odd + even);
}

#endif
