#!/usr/bin/env bash
# All GPU work, unattended, on a bare machine that has torch, nvcc and this folder; leaves OUTPUT/gpu.json.
#
#     benchmarks/gpu.sh [--scene DIR] [--wheels DIR] [--lpips DIR] [--output DIR] [--budget SECONDS] [STAGE...]
#
# Stages, in this order: install build parity steps render train eval eager; all of them where none is named. Each has
# a limit and leaves its log; what fails or runs out of time is in the JSON with its exit code (124: out of time) and the rest
# goes on. Training that runs out of time saves; a second call with `train eval` and the same OUTPUT goes on with it.
#
# --wheels: a folder with wheels of what the machine lacks, for machines without a package index:
#     pip download --only-binary :all: --no-deps --dest wheels gsplat tyro pycolmap filelock safetensors beartype \
#         shtab typeguard docstring-parser pytest-timeout hypothesis sortedcontainers jaxtyping wadler-lindig
# with --python-version and --platform of that machine where they are not this one's.
set -uo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root" || exit 1
scene= wheels= lpips= output=gpu-out budget=540 stages=()
for guess in shared/data/gate ../shared/data/gate; do
  if [ -z "$scene" ] && [ -d "$guess/images" ]; then scene=$guess; fi
done
while [ $# -gt 0 ]; do
  case $1 in
    --scene) scene=$2; shift 2 ;;
    --wheels) wheels=$2; shift 2 ;;
    --lpips) lpips=$2; shift 2 ;;
    --output) output=$2; shift 2 ;;
    --budget) budget=$2; shift 2 ;;
    -h | --help) sed -n '2,15p' "${BASH_SOURCE[0]}"; exit 0 ;;
    -*) echo "gpu.sh: unknown option $1; --help lists them" >&2; exit 2 ;;
    *) stages+=("$1"); shift ;;
  esac
done
[ ${#stages[@]} -gt 0 ] || stages=(install build parity steps render train eval eager)

python=${PYTHON:-python3}
steps=${STEPS:-30000}
mkdir -p "$output/parts" || exit 1
output=$(cd "$output" && pwd)
parts=$output/parts
export PYTHONPATH="$root/src:$root/benchmarks${PYTHONPATH:+:$PYTHONPATH}" HF_HUB_OFFLINE=${HF_HUB_OFFLINE:-1}
export TORCH_EXTENSIONS_DIR=${TORCH_EXTENSIONS_DIR:-$output/extensions}
export MAX_JOBS=${MAX_JOBS:-$(nproc)}
# For this GPU alone: gsplat's kernels take minutes for each architecture.
TORCH_CUDA_ARCH_LIST=${TORCH_CUDA_ARCH_LIST:-$("$python" -c '
import torch
print("{}.{}".format(*torch.cuda.get_device_capability()))' 2>/dev/null)}
export TORCH_CUDA_ARCH_LIST
if [ -z "$TORCH_CUDA_ARCH_LIST" ]; then
  echo "gpu.sh: torch sees no GPU here ($python)" >&2
  exit 1
fi

# run NAME LIMIT COMMAND...: stdout to parts/NAME.out, stderr to parts/NAME.log, a line to parts/stages.jsonl.
run() {
  local name=$1 limit=$2 left began code
  shift 2
  left=$((budget - SECONDS - 10))
  [ "$limit" -le "$left" ] || limit=$left
  began=$SECONDS
  if [ "$limit" -lt 5 ]; then
    code=124
    : >"$parts/$name.out"
  else
    timeout --signal=TERM --kill-after=15 "$limit" "$@" >"$parts/$name.out" 2>"$parts/$name.log"
    code=$?
  fi
  echo "{\"stage\": \"$name\", \"exit_code\": $code, \"seconds\": $((SECONDS - began))}" >>"$parts/stages.jsonl"
  echo "$name: exit code $code after $((SECONDS - began)) s"
  [ "$code" -eq 0 ] || tail -n 3 "$parts/$name.log" 2>/dev/null
  return 0
}

install() {
  local wanted=() missing=()
  # module:package
  for pair in tyro:tyro filelock:filelock safetensors:safetensors jaxtyping:jaxtyping rich:rich numba:numba \
    scipy:scipy pycolmap:pycolmap transformers:transformers tensorboard:tensorboard yaml:pyyaml PIL:pillow \
    gsplat:gsplat beartype:beartype pytest:pytest pytest_timeout:pytest-timeout hypothesis:hypothesis; do
    wanted+=("$pair")
  done
  for pair in "${wanted[@]}"; do
    "$python" -c "import importlib.util, sys; sys.exit(importlib.util.find_spec('${pair%%:*}') is None)" ||
      missing+=("${pair##*:}")
  done
  [ ${#missing[@]} -gt 0 ] || return 0
  echo "missing: ${missing[*]}"
  # torch as it is here stays: only what is missing, and what that needs, is installed.
  "$python" -c 'import torch; print("torch==" + torch.__version__)' >"$parts/constraints.txt"
  if [ -n "$wheels" ]; then
    "$python" -m pip install --no-index --find-links "$wheels" --constraint "$parts/constraints.txt" "${missing[@]}"
  else
    "$python" -m pip install --constraint "$parts/constraints.txt" "${missing[@]}"
  fi
}

for stage in "${stages[@]}"; do
  case $stage in
    install)
      export -f install
      export python parts wheels
      run install 90 bash -c install
      ;;
    build)
      run build 240 "$python" -c 'import gsplat.cuda._wrapper as w; from gsplat import rasterization
from gsplat.cuda._backend import _C
assert _C is not None, "gsplat has no CUDA code here"'
      ;;
    parity)
      run parity 120 "$python" -m pytest -q -p no:cacheprovider -m cuda --junitxml "$parts/parity.xml" \
        tests/rasterize tests/model tests/engine
      ;;
    steps)
      run steps 90 "$python" benchmarks/train_step.py --json
      ;;
    render)
      run render 40 "$python" benchmarks/rasterize.py --json --backends cuda --n 1000000 --sizes 500x375 1000x750
      ;;
    train)
      if [ -z "$scene" ]; then
        echo "train: no scene; give one with --scene" | tee "$parts/train.log"
        continue
      fi
      resume=()
      [ ! -f "$output/run/config.yaml" ] || resume=(--resume)
      run train $((budget - SECONDS - 50)) "$python" -m wildgs train "$scene" --output "$output/run" \
        --steps "$steps" --checkpoint-minutes 1 "${resume[@]}"
      ;;
    eval)
      run eval 60 "$python" -m wildgs eval "$output/run" --protocol both ${lpips:+--lpips "$lpips"}
      ;;
    eager)
      run eager 45 "$python" benchmarks/train_step.py --json --eager --n 1000000
      ;;
    *)
      echo "gpu.sh: unknown stage $stage" >&2
      exit 2
      ;;
  esac
done

"$python" benchmarks/gpu_report.py "$output"
