"""Random numbers: as plain integer arithmetic, equal in lanes, uniform, normal, independent streams."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
import taichi as ti

from tests.oracles import noise as reference
from uuvtai.kernels.core import noise
from uuvtai.kernels.core.simd import LANES

N = 1 << 16
BINS = 256
CHI2_LIMIT = 374.0
"""99.9999 % point of chi-squared with 255 degrees of freedom: fails by chance once in a million."""
POLYNOMIAL_ERROR = 1.0e-3
"""the logarithm is off by at most 8e-5, which at the smallest radii (0.004) is 2 % of them; sine and cosine
by 7e-6"""
SIGMAS = 5.0
"""bound of sample means and correlations in standard errors"""


@ti.kernel
def draw_scalar(
    word: ti.template(), unit: ti.template(), gauss: ti.template(), a: ti.i32, b: ti.i32, c: ti.i32, d: ti.i32
):
    key = noise.stream_key(noise.episode_key(a, b), c, d)
    for i in word:
        word[i] = noise.bits(key, i)
        unit[i] = noise.uniform(key, i)
        gauss[i] = noise.normal(key, i)


@ti.kernel
def draw_lanes(
    word: ti.template(), unit: ti.template(), gauss: ti.template(), a: ti.i32, b: ti.i32, c: ti.i32, d: ti.i32
):
    key = noise.stream_key(noise.episode_key(a, b), c, d)
    for packet in range(ti.static(N // LANES)):
        words = noise.bits_lanes(key, packet * LANES, LANES)
        units = noise.uniform_lanes(key, packet * LANES, LANES)
        normals, _ = noise.normal_pair_lanes(key, packet * LANES, LANES)
        for lane in ti.static(range(LANES)):
            word[packet * LANES + lane] = words[lane]
            unit[packet * LANES + lane] = units[lane]
            gauss[packet * LANES + lane] = normals[lane]


@pytest.fixture(scope="module")
def drawn():
    """draws(lanes, seed, episode, step, stream) -> bits, uniforms, normals."""
    fields = ti.field(ti.u32, N), ti.field(ti.f32, N), ti.field(ti.f32, N)

    def draws(lanes, *key):
        (draw_lanes if lanes else draw_scalar)(*fields, *key)
        return [field.to_numpy() for field in fields]

    return draws


@ti.kernel
def draw_pairs(one: ti.template(), other: ti.template(), a: ti.i32, b: ti.i32, c: ti.i32, d: ti.i32):
    key = noise.stream_key(noise.episode_key(a, b), c, d)
    for packet in range(ti.static(N // LANES)):
        x, y = noise.normal_pair_lanes(key, packet * LANES, LANES)
        for lane in ti.static(range(LANES)):
            one[packet * LANES + lane] = x[lane]
            other[packet * LANES + lane] = y[lane]


@pytest.fixture(scope="module")
def pairs():
    """pairs(seed, episode, step, stream) -> two arrays of normals, float64."""
    fields = ti.field(ti.f32, N), ti.field(ti.f32, N)

    def draws(*key):
        draw_pairs(*fields, *key)
        return [field.to_numpy().astype(float) for field in fields]

    return draws


KEYS = [(0, 0, 0, 1), (7, 123, 2999, 15), (2**31 - 1, 2**31 - 1, 29999, 3)]


@pytest.mark.parametrize("key", KEYS)
def test_draws_equal_plain_integers(drawn, key):
    seed, episode, step, stream = key
    word, unit, _ = drawn(False, *key)
    expected = reference.stream_key(reference.episode_key(seed, episode), step, stream)
    assert [reference.bits(expected, i) for i in range(500)] == list(word[:500])
    assert np.array_equal(reference.uniforms(expected, 500).astype(np.float32), unit[:500])


@pytest.mark.parametrize("key", KEYS)
def test_lanes_equal_scalars(drawn, key):
    scalar, lanes = drawn(False, *key), drawn(True, *key)
    assert np.array_equal(scalar[0], lanes[0])
    assert np.array_equal(scalar[1], lanes[1])


@pytest.mark.parametrize("key", KEYS)
def test_uniforms_fill_every_bin(drawn, key):
    _, unit, _ = drawn(False, *key)
    assert unit.min() >= 0.0 and unit.max() < 1.0
    counts = np.histogram(unit, BINS, (0.0, 1.0))[0]
    assert np.sum((counts - N / BINS) ** 2 / (N / BINS)) < CHI2_LIMIT


@pytest.mark.parametrize("key", KEYS)
def test_every_bit_is_fair(drawn, key):
    word = drawn(False, *key)[0]
    for bit in range(32):
        assert abs(np.mean(word >> bit & 1) - 0.5) < SIGMAS * 0.5 / np.sqrt(N)


@pytest.mark.parametrize("lanes", [False, True])
def test_normals_have_the_moments_of_a_normal(drawn, lanes):
    gauss = drawn(lanes, 3, 4, 5, 6)[2].astype(float)
    assert abs(gauss.mean()) < SIGMAS / np.sqrt(N)
    assert abs(gauss.std() - 1.0) < SIGMAS / np.sqrt(2 * N)
    assert abs(np.mean(gauss**3)) < SIGMAS * np.sqrt(15.0 / N)
    kurtosis = np.mean(gauss**4) - 3.0
    assert abs(kurtosis) < SIGMAS * np.sqrt(96.0 / N)


def test_both_normals_of_a_pair_are_normal_and_independent(pairs):
    """Kolmogorov-Smirnov: sqrt(N) D exceeds 2.5 once in 100,000; squares are uncorrelated too."""
    one, other = pairs(3, 4, 5, 6)
    cdf = (np.arange(N) + 0.5) / N
    for gauss in (one, other):
        assert (
            np.sqrt(N) * np.abs(0.5 * (1 + np.vectorize(math.erf)(np.sort(gauss) / np.sqrt(2))) - cdf).max()
            < 2.5
        )
    for a, b in ((one, other), (one**2, other**2), (one, other**2)):
        assert abs(np.corrcoef(a, b)[0, 1]) < SIGMAS / np.sqrt(N)


def test_every_radius_and_angle_of_a_pair(pairs):
    """Each of 2^16 uniforms of radius and angle gives Box-Muller's value in float64."""
    one, other = pairs(3, 4, 5, 6)
    key = reference.stream_key(reference.episode_key(3, 4), 5, 6)
    word = np.array([reference.bits(key, i) for i in range(N)])
    radius = np.sqrt(-2.0 * np.log(((word >> 16) + 0.5) / 65536.0))
    angle = 2.0 * np.pi * ((word & 0xFFFF) - 32767.5) / 65536.0
    np.testing.assert_allclose(one, radius * np.cos(angle), atol=POLYNOMIAL_ERROR)
    np.testing.assert_allclose(other, radius * np.sin(angle), atol=POLYNOMIAL_ERROR)
    assert np.unique(word >> 16).size > 0.6 * N and (word >> 16).max() == 65535, (
        "the radius next to 0 is among them"
    )


@pytest.mark.parametrize("other", [(3, 4, 5, 7), (3, 4, 6, 6), (3, 5, 5, 6), (4, 4, 5, 6)])
@pytest.mark.parametrize("lanes", [False, True])
def test_neighbouring_streams_are_independent(drawn, lanes, other):
    _, unit, gauss = drawn(lanes, 3, 4, 5, 6)
    _, other_unit, other_gauss = drawn(lanes, *other)
    for a, b in ((unit, other_unit), (gauss, other_gauss)):
        assert abs(np.corrcoef(a, b)[0, 1]) < SIGMAS / np.sqrt(N)
        assert abs(np.corrcoef(a[1:], b[:-1])[0, 1]) < SIGMAS / np.sqrt(N)


@pytest.mark.parametrize("lanes", [False, True])
def test_draws_of_one_stream_are_independent(drawn, lanes):
    _, unit, gauss = drawn(lanes, 8, 9, 10, 11)
    for values in (unit, gauss):
        for lag in (1, 2, 3, LANES):
            assert abs(np.corrcoef(values[lag:], values[:-lag])[0, 1]) < SIGMAS / np.sqrt(N)


def test_keys_of_episodes_do_not_collide():
    keys = {reference.episode_key(seed, episode) for seed in range(50) for episode in range(400)}
    expected_collisions = (50 * 400) ** 2 / 2 / 2**32  # 0.05
    assert 50 * 400 - len(keys) <= expected_collisions + 3


def streams_of(sources):
    """{number: names} of the constants STREAM_... in these texts."""
    found = {}
    for source in sources:
        for name, number in re.findall(r"^(STREAM_\w+) = (\d+)", source, re.MULTILINE):
            found.setdefault(int(number), []).append(name)
    return found


def test_no_two_streams_have_one_number():
    """A sensor may keep its stream in its own file."""
    assert streams_of(["STREAM_A = 3\n", "STREAM_B = 3\n"]) == {3: ["STREAM_A", "STREAM_B"]}
    kernels = Path(noise.__file__).parents[1]
    streams = streams_of(path.read_text() for path in kernels.rglob("*.py"))
    assert len(streams) > 10 and [names for names in streams.values() if len(names) > 1] == []
