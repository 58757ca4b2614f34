#!/usr/bin/env bash
# All GPU work, unattended, on a bare machine that has torch, nvcc and this folder; leaves OUTPUT/gpu.json.
#
#     benchmarks/gpu.sh [--scene DIR] [--wheels DIR] [--lpips DIR] [--output DIR] [--budget SECONDS] [--dry-run] [STAGE...]
#
# Stages, in this order, where none is named: install build parity eager graphs profile steps render train eval pack.
# By name only: host (where Python spends a step), features (a step without each of WILDGS_WITHOUT's features), tests
# (all tests marked cuda).
# Each has a limit, and its results are on disk before the next begins; what fails or runs out of time is in the JSON with
# its exit code (124: out of time) and the rest continues. The limits leave the last RESERVE seconds of the budget to
# training and what follows. An interrupted build or training continues with a second call and the same OUTPUT.
#
# --wheels: a folder with wheels of what the machine lacks, for machines without a package index; those are installed
#   whose package is not there, without their dependencies, so that torch stays as it is. To fill it:
#     pip download --only-binary :all: --no-deps --dest wheels gsplat==1.5.3 tyro pycolmap filelock safetensors beartype \
#         shtab typeguard docstring-parser pytest-timeout hypothesis sortedcontainers jaxtyping wadler-lindig
#   with --python-version and --platform of that machine where they are not this one's.
# --dry-run: every stage on the CPU in tiny sizes, to see that the stages themselves work.
set -uo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
scene= wheels= lpips= output=gpu-out budget= dry= stages=()
while [ $# -gt 0 ]; do
  case $1 in
    --scene) scene=$2; shift 2 ;;
    --wheels) wheels=$2; shift 2 ;;
    --lpips) lpips=$2; shift 2 ;;
    --output) output=$2; shift 2 ;;
    --budget) budget=$2; shift 2 ;;
    --dry-run) dry=1; shift ;;
    -h | --help) sed -n '2,20p' "${BASH_SOURCE[0]}"; exit 0 ;;
    -*) echo "gpu.sh: unknown option $1; --help lists the options" >&2; exit 2 ;;
    *) stages+=("$1"); shift ;;
  esac
done
mkdir -p "$output/parts" || exit 1
output=$(cd "$output" && pwd)
cd "$root" || exit 1
for guess in shared/data/gate ../shared/data/gate; do
  if [ -z "$scene" ] && [ -d "$guess/images" ]; then scene=$guess; fi
done
[ ${#stages[@]} -gt 0 ] || stages=(install build parity eager graphs profile steps render train eval pack)

python=${PYTHON:-python3}
steps=${STEPS:-30000}
[ -n "$budget" ] || budget=$([ -n "$dry" ] && echo 3000 || echo 540)
reserve=170 # seconds of the budget for training, scores and packing, where a training follows
[[ " ${stages[*]} " == *" train "* ]] || reserve=0
parts=$output/parts
export PYTHONPATH="$root/src:$root/benchmarks:$root${PYTHONPATH:+:$PYTHONPATH}" HF_HUB_OFFLINE=${HF_HUB_OFFLINE:-1}
export TORCH_EXTENSIONS_DIR=${TORCH_EXTENSIONS_DIR:-$output/extensions}
export MAX_JOBS=${MAX_JOBS:-$(nproc)}
tiny=() step_sizes=(--width 1000 --n 1000000 --steps 8) render_sizes=(--backends cuda --n 1000000 100000 --sizes 1000x750)
train_sizes=()
if [ -n "$dry" ]; then
  export CUDA_VISIBLE_DEVICES=
  tiny=(--tiny) step_sizes=(--width 48 --n 200 --steps 1 --photos 8) render_sizes=(--backends cpu --n 200 --sizes 32x24)
  train_sizes=(--wrapping.resolution 8 --parsing.max-side 64 --max-gaussians 300 --log-every 1)
elif [ -z "${TORCH_CUDA_ARCH_LIST:-}" ]; then
  # For this GPU alone: gsplat's kernels take minutes for each architecture.
  TORCH_CUDA_ARCH_LIST=$("$python" -c '
import torch
print("{}.{}".format(*torch.cuda.get_device_capability()))' 2>/dev/null)
  if [ -z "$TORCH_CUDA_ARCH_LIST" ]; then
    echo "gpu.sh: torch sees no GPU here ($python)" >&2
    exit 1
  fi
  export TORCH_CUDA_ARCH_LIST
fi

# run NAME LIMIT KEPT COMMAND...: at most LIMIT seconds, and KEPT seconds of the budget left to later stages.
# stdout to parts/NAME.out, stderr to parts/NAME.log, a line to parts/stages.jsonl.
run() {
  local name=$1 limit=$2 kept=$3 left began code
  shift 3
  [ -z "$dry" ] || limit=600
  left=$((budget - SECONDS - kept))
  [ "$limit" -le "$left" ] || limit=$left
  began=$SECONDS
  if [ "$limit" -lt 5 ]; then
    code=124
    : >"$parts/$name.out"
  else
    timeout --signal=TERM --kill-after=15 "$limit" "$@" >"$parts/$name.out" 2>"$parts/$name.log"
    code=$?
  fi
  echo "{\"stage\": \"$name\", \"exit_code\": $code, \"seconds\": $((SECONDS - began)), \"limit\": $limit}" \
    >>"$parts/stages.jsonl"
  sync "$parts" 2>/dev/null
  echo "$name: exit code $code after $((SECONDS - began)) s"
  [ "$code" -eq 0 ] || tail -n 3 "$parts/$name.log" 2>/dev/null
  return 0
}

# What is not there, without dependencies: pip would replace a torch whose version it does not know ("2.11.0+cu130").
install() {
  "$python" - "$wheels" <<'CODE'
import importlib.metadata, pathlib, subprocess, sys

def lacks(package):
    try:
        importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return True
    return False

folder = sys.argv[1]
if folder:
    wanted = [str(w) for w in sorted(pathlib.Path(folder).glob("*.whl")) if lacks(w.name.split("-")[0])]
    options = ["--no-index", "--no-deps"]
else:
    names = ["gsplat==1.5.3", "tyro", "shtab", "typeguard", "docstring-parser", "pycolmap", "filelock", "safetensors",
             "jaxtyping", "wadler-lindig", "rich", "markdown-it-py", "mdurl", "pygments", "numba", "llvmlite", "scipy",
             "transformers", "huggingface-hub", "tokenizers", "tensorboard", "pyyaml", "pillow", "beartype", "pytest",
             "pytest-timeout", "iniconfig", "pluggy", "hypothesis", "sortedcontainers", "packaging", "ninja"]
    wanted = [n for n in names if lacks(n.split("==")[0])]
    options = ["--no-deps", "--retries", "1", "--timeout", "5"]
print("missing:", *wanted)
if wanted:
    sys.exit(subprocess.call([sys.executable, "-m", "pip", "install", *options, *wanted]))
CODE
}

for stage in "${stages[@]}"; do
  case $stage in
    install)
      if [ -n "$dry" ]; then run install 20 "$reserve" "$python" -c 'import torch'; continue; fi
      export -f install
      export python wheels
      run install 60 "$reserve" bash -c install
      if ! "$python" -c 'import importlib.util, sys; sys.exit(importlib.util.find_spec("gsplat") is None)'; then
        echo "gpu.sh: gsplat is missing and could not be installed ($parts/install.log); --help says how to carry wheels" >&2
        exit 1
      fi
      ;;
    build)
      # Without a GPU gsplat's interface is compared, and nothing is built.
      build=("$python" -m wildgs doctor --build-gsplat)
      [ -z "$dry" ] || build=("$python" -c 'from wildgs.rasterize.gsplat_library import import_gsplat; import_gsplat()')
      run build 200 "$reserve" "${build[@]}"
      ;;
    parity)
      # Warnings of that machine's libraries are shown, not errors.
      run parity 60 "$reserve" "$python" -m pytest -q -W default -p no:cacheprovider ${dry:+--collect-only} \
        -m "cuda" --junitxml "$parts/parity.xml" tests/rasterize/test_parity.py tests/model/test_cuda.py
      ;;
    eager) run eager 40 "$reserve" env CUDA_LAUNCH_BLOCKING=1 "$python" benchmarks/gpu_stages.py eager "${tiny[@]}" ;;
    graphs) run graphs 40 "$reserve" "$python" benchmarks/gpu_stages.py graphs "${tiny[@]}" ;;
    profile) run profile 40 "$reserve" "$python" benchmarks/gpu_stages.py profile "${tiny[@]}" ;;
    host) run host 100 0 "$python" benchmarks/gpu_stages.py host "${tiny[@]}" ;;
    steps) run steps 35 "$reserve" "$python" benchmarks/train_step.py --json "${step_sizes[@]}" ;;
    render) run render 20 "$reserve" "$python" benchmarks/rasterize.py --json "${render_sizes[@]}" ;;
    features) run features 240 0 "$python" benchmarks/gpu_stages.py features "${tiny[@]}" ;;
    tests)
      run tests 400 10 "$python" -m pytest -q -W default -p no:cacheprovider -m cuda --junitxml "$parts/tests.xml" \
        tests/rasterize tests/model tests/engine
      ;;
    train)
      if [ -z "$scene" ]; then
        echo "train: no scene; give one with --scene" | tee "$parts/train.log"
        continue
      fi
      resume=()
      [ ! -f "$output/run/config.yaml" ] || resume=(--resume)
      run train "$budget" 50 "$python" -m wildgs train "$scene" --output "$output/run" --steps "$steps" \
        --checkpoint-minutes 1 "${train_sizes[@]}" "${resume[@]}"
      ;;
    eval) run eval 60 10 "$python" -m wildgs eval "$output/run" --protocol both ${lpips:+--lpips "$lpips"} ;;
    pack) "$python" benchmarks/gpu_report.py "$output" && tar -C "$output" -czf "$output/gpu.tar.gz" parts gpu.json ;;
    *)
      echo "gpu.sh: unknown stage $stage" >&2
      exit 2
      ;;
  esac
done
[[ " ${stages[*]} " == *" pack "* ]] || "$python" benchmarks/gpu_report.py "$output"
