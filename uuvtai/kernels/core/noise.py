"""Counter-based random numbers: every draw is a pure function of (key, step, stream, index).

``ti.random`` depends on the thread count, so it is never used. A key stands for one (seed, episode); the
streams below keep draws of different purposes apart. The mixer is the 32-bit finaliser "lowbias32" (C.
Wellons, hash-prospector, bias 0.17).
"""

import taichi as ti

from uuvtai.kernels.core.stage import Const

# one stream per purpose; a stream's draws never meet another's
STREAM_SCENARIO = 1
STREAM_PATH = 2
STREAM_SONAR_RANGE = 3
STREAM_SONAR_DOPPLER = 4
STREAM_SONAR_DROP = 5
STREAM_SONAR_CLUTTER = 6
STREAM_SONAR_GHOST = 7
STREAM_DEPTH = 8
STREAM_DVL = 9
STREAM_IMU = 10
STREAM_PRESSURE = 11
STREAM_CURRENT = 12
STREAM_VEHICLE = 13
STREAM_THRUSTER = 14
STREAM_SONAR_NORMAL = 16
STREAM_MPPI = 17
STREAM_SONAR_SPECKLE = 18
STREAM_SONAR_HISS = 19

_GOLDEN = 0x9E3779B9
_TO_UNIT = 1.0 / 16777216.0  # 24 random bits fill a float32 mantissa exactly: [0, 1) on the grid of 2^-24.

_SINE = (0.999999246, -0.166656827, 0.00831325872, -0.000185243574)
_COSINE = (0.9999933, -0.49991244, 0.04148775, -0.00127121)
_LOGARITHM = (0.304101515, -0.165702563, 0.0569286753)
"""Least-maximum polynomials of sin(x)/x and cos(x) in x^2 on [0, (pi/2)^2] (errors 8e-7 and 7e-6) and of
(ln(1 + t)/t - ln 2)/(1 - t) on [0, 1], so that the logarithm is exact at both ends (error 8e-5)."""

_LN2 = 0.6931471805599453
_PI = 3.141592653589793


@ti.func
def mixed(x):
    """One round of lowbias32."""
    h = x
    h ^= h >> 16
    h *= ti.u32(0x7FEB352D)
    h ^= h >> 15
    h *= ti.u32(0x846CA68B)
    h ^= h >> 16
    return h


@ti.func
def episode_key(seed, episode):
    """Key of one episode of one seed."""
    return mixed(
        mixed(ti.cast(seed, ti.u32) + ti.u32(_GOLDEN)) ^ (ti.cast(episode, ti.u32) * ti.u32(0x85EBCA6B))
    )


@ti.func
def stream_key(key, step, stream):
    """Key of one stream at one step; feed it to the draws below with an index."""
    return mixed(
        mixed(key ^ (ti.cast(step, ti.u32) * ti.u32(_GOLDEN))) + ti.cast(stream, ti.u32) * ti.u32(0xC2B2AE35)
    )


@ti.func
def bits(key, index):
    """32 random bits."""
    return mixed(key ^ mixed(ti.cast(index, ti.u32) + ti.u32(_GOLDEN)))


@ti.func
def uniform(key, index):
    """Uniform in [0, 1), 24 bits."""
    return ti.cast(bits(key, index) >> 8, ti.f32) * _TO_UNIT


@ti.func
def uniform_in(key, index, low, high):
    """Uniform in [low, high)."""
    return low + (high - low) * uniform(key, index)


@ti.func
def normal(key, index):
    """Standard normal by Box-Muller; uses the draws 2 * index and 2 * index + 1."""
    radius = ti.sqrt(-2.0 * ti.log(1.0 - uniform(key, 2 * index)))
    return radius * ti.cos(6.283185307179586 * uniform(key, 2 * index + 1))


@ti.func
def mixed_lanes(x):
    """One round of lowbias32 in lanes."""
    a = x ^ (x >> 16)
    b = a * ti.u32(0x7FEB352D)
    c = b ^ (b >> 15)
    d = c * ti.u32(0x846CA68B)
    e = d ^ (d >> 16)
    return e


@ti.func
def bits_lanes(key, first_index, lanes: Const[int]):
    """32 random bits per lane; lane i equals ``bits(key, first_index + i)``."""
    counter = ti.Vector([ti.cast(first_index + i, ti.u32) + ti.u32(_GOLDEN) for i in range(lanes)])
    inner = mixed_lanes(counter)
    keyed = inner ^ key
    return mixed_lanes(keyed)


@ti.func
def uniform_lanes(key, first_index, lanes: Const[int]):
    """Uniform in [0, 1) per lane; lane i equals ``uniform(key, first_index + i)``."""
    raw = bits_lanes(key, first_index, lanes)
    shifted = raw >> 8
    return ti.cast(shifted, ti.f32) * _TO_UNIT


@ti.func
def polynomial(x, coefficients: Const[tuple]):
    """c0 + c1 x + c2 x^2 + ... by Horner's rule."""
    out = x * coefficients[-1] + coefficients[-2]
    for i in ti.static(range(len(coefficients) - 2)):
        out = out * x + ti.static(coefficients[len(coefficients) - 3 - i])
    return out


@ti.func
def normal_pair_lanes(key, first_index, lanes: Const[int]):
    """Two independent standard normals per lane from one word of 32 bits: Box-Muller with polynomials, |x| <=
    4.9.

    Taichi does not vectorise log, sin and cos. The upper half of the word is the radius's uniform (k + 1/2) /
    2^16, the lower the angle's.
    """
    word = bits_lanes(key, first_index, lanes)
    odd = ti.cast(((word >> 15) & ti.u32(0x1FFFE)) | ti.u32(1), ti.f32)  # 2 k + 1, exact
    raw = ti.bit_cast(odd, ti.i32)
    exponent = ti.cast((raw >> 23) - 144, ti.f32)  # of the uniform: 127 is float's bias, 17 divides by 2^17
    fraction = ti.bit_cast((raw & 0x7FFFFF) | 0x3F800000, ti.f32) - 1.0
    log_fraction = fraction * (_LN2 + (1.0 - fraction) * polynomial(fraction, _LOGARITHM))
    radius = ti.sqrt(exponent * (-2.0 * _LN2) - 2.0 * log_fraction)
    half = (ti.cast(word & ti.u32(0xFFFF), ti.f32) - 32767.5) * (
        _PI / 65536.0
    )  # half of the angle, within +- pi / 2
    square = half * half
    sine = half * polynomial(square, _SINE)
    cosine = polynomial(square, _COSINE)
    return radius * (1.0 - 2.0 * sine * sine), radius * (2.0 * sine * cosine)
