"""Float64 and integer oracle of the counter-based random numbers, in plain Python integers."""

import numpy as np

MASK = 0xFFFFFFFF


def mixed(x: int) -> int:
    """lowbias32 (C. Wellons)."""
    x ^= x >> 16
    x = x * 0x7FEB352D & MASK
    x ^= x >> 15
    x = x * 0x846CA68B & MASK
    return x ^ x >> 16


def episode_key(seed: int, episode: int) -> int:
    return mixed(mixed(seed + 0x9E3779B9 & MASK) ^ (episode * 0x85EBCA6B & MASK))


def stream_key(key: int, step: int, stream: int) -> int:
    return mixed(mixed(key ^ (step * 0x9E3779B9 & MASK)) + stream * 0xC2B2AE35 & MASK)


def bits(key: int, index: int) -> int:
    return mixed(key ^ mixed(index + 0x9E3779B9 & MASK))


def uniforms(key: int, count: int) -> np.ndarray:
    return np.array([(bits(key, i) >> 8) / 2.0**24 for i in range(count)])
