#!/bin/bash
# The whole stack on a CUDA device that has torch with CUDA and no network, within BUDGET_S seconds (360).
#
#   bash benchmarks/gpu.sh carry   here, with PyPI: fills .wheels/ with what the device's Python (PYTHON_THERE,
#                                  3.12) lacks and says how large tree and wheels are
#   bash benchmarks/gpu.sh         there, with .wheels/ beside the tree (or uuvtai installed): results in OUT
#   bash benchmarks/gpu.sh rehearse  here, on the CPU: does every step of it run? Rates mean nothing then
#
# What would stop everything comes first; each step has its own limit and leaves what it found.
set -u
cd "$(dirname "$0")/.."
PY=${PYTHON:-python3}
DEVICE=cuda
SIZES=(16384 4096 65536)
if [ "${1:-}" = carry ]; then
    set -e
    rm -rf .wheels && mkdir .wheels
    made=$(mktemp -d) && trap 'rm -rf "$made"' EXIT
    there=(--no-deps --only-binary=:all: --python-version "${PYTHON_THERE:-3.12}" --implementation cp)
    for glibc in 2_28 2_27 2_24 2_17; do there+=(--platform "manylinux_${glibc}_x86_64"); done
    there+=(--platform manylinux2014_x86_64)
    "$PY" -m pip download -q "${there[@]}" -d "$made" taichi==1.7.4
    # without its C interface and its examples Taichi is half as large; llvmlite is for CPUs alone; pydantic and
    # its core fit in pairs
    (cd "$made" && "$PY" -m zipfile -e taichi-*.whl . && rm -rf taichi/_lib/c_api taichi/examples)
    tar -C "$made" -cJf .wheels/taichi.tar.xz taichi taichi-1.7.4.dist-info
    "$PY" -m pip download -q "${there[@]}" -d .wheels pydantic==2.13.4 pydantic-core==2.46.4 annotated-types \
        typing-inspection mcap zstandard ompl dill colorama safetensors typer rich pyyaml pytest
    du -sh .wheels
    git ls-files -z | xargs -0 stat -c %s | awk '{ s += $1 } END { printf "%.1f MiB in the tree\n", s / 2^20 }'
    exit
elif [ "${1:-}" = rehearse ]; then
    DEVICE=cpu
    SIZES=(64)
fi
OUT=${OUT:-$(mktemp -d)}
mkdir -p "$OUT"
exec > >(tee "$OUT/gpu.txt") 2>&1
begun=$(date +%s)
left() { echo $((${BUDGET_S:-360} - $(date +%s) + begun)); }
step() { # NAME LIMIT_S COMMAND...
    local name=$1 limit=$2 rest since rc
    shift 2
    rest=$(left) since=$(date +%s)
    ((rest < 15)) && { echo "### $name: left out, $rest s left" && return 9; }
    timeout -k 5 $((limit < rest ? limit : rest)) "$@"
    rc=$?
    echo "### $name: rc $rc after $(($(date +%s) - since)) s"
    return $rc
}
export PYTHONUNBUFFERED=1 UUV_NATIVE_CACHE="$OUT/native" PYTHONPATH="$PWD"
if [ -d .wheels ] && [ $DEVICE = cuda ]; then
    site=$(mktemp -d) && export PYTHONPATH="$PWD:$site"
    tar -C "$site" -xJf .wheels/taichi.tar.xz || exit 3
    "$PY" -m pip install -q --no-index --no-deps --no-compile --target "$site" .wheels/*.whl || exit 3
    # Taichi asks the loader for libcuda.so; some machines have libcuda.so.1 alone
    "$PY" -c 'import ctypes; ctypes.CDLL("libcuda.so")' 2>/dev/null || {
        mkdir -p "$site/cuda" && ln -s "$(ldconfig -p | awk '/libcuda.so.1/ { print $NF; exit }')" "$site/cuda/libcuda.so"
        export LD_LIBRARY_PATH="$site/cuda:${LD_LIBRARY_PATH:-}"
    }
fi
[ $DEVICE = cuda ] && step machine 30 nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv
step doctor 60 "$PY" -m uuvtai doctor
step first_step 150 "$PY" benchmarks/run.py scale --device $DEVICE --num-envs 64 --seconds 1 --out "$OUT" || exit 5
[ $DEVICE = cuda ] && step agreement 120 "$PY" -m pytest -q -p no:cacheprovider tests/repository/test_gpu.py -m gpu
for n in "${SIZES[@]}"; do # each its own process: an error at one size leaves the others
    step "rate_$n" 100 "$PY" benchmarks/run.py scale --device $DEVICE --num-envs "$n" --seconds 1 --out "$OUT/$n"
done
step train 60 "$PY" -m uuvtai train paper --iterations 3 --set stack=null --set train.num_envs="${SIZES[-1]}" \
    --device $DEVICE --run-dir "$OUT/train"
echo "### done, $(left) s left; results in $OUT"
