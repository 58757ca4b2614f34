#!/usr/bin/env bash
# Compiles gsplat's CUDA sources and links them, on a machine with nvcc and without a GPU.
#
#     benchmarks/compile_gsplat.sh [--python PYTHON] [--arch 9.0] [--output DIR] [--only PATTERN]
#
# PYTHON's environment needs a torch built for CUDA (`pip install --no-deps torch`), the headers of cuBLAS, cuSPARSE and
# cuSOLVER (nvidia-cublas, nvidia-cusparse, nvidia-cusolver) and gsplat; torch is not imported. One object at a time; objects
# that are newer than their source are kept, so that an interrupted call continues. OUTPUT/log has one line a file.
# --only: file names to compile (a shell pattern); nothing is linked then.
set -euo pipefail
shopt -s extglob

python=python3 arch=9.0 output=gsplat-build only=
while [ $# -gt 0 ]; do
  case $1 in
    --python) python=$2; shift 2 ;;
    --arch) arch=$2; shift 2 ;;
    --output) output=$2; shift 2 ;;
    --only) only=$2; shift 2 ;;
    -h | --help) sed -n '2,11p' "${BASH_SOURCE[0]}"; exit 0 ;;
    *) echo "compile_gsplat.sh: unknown option $1; --help lists the options" >&2; exit 2 ;;
  esac
done

folder_of() {
  "$python" -c "import importlib.util as u; print(next(iter(u.find_spec('$1').submodule_search_locations)))"
}
torch=$(folder_of torch) gsplat=$(folder_of gsplat)/cuda
mkdir -p "$output"
log=$output/log
echo "# $(date -u +%FT%TZ) gsplat $gsplat, nvcc $(nvcc --version | sed -n "s,.*release \([0-9.]*\).*,\1,p")" >>"$log"
includes=(-I"$gsplat/include" -I"$gsplat/csrc/third_party/glm" -I"$torch/include"
  -I"$torch/include/torch/csrc/api/include" -I"$("$python" -c 'import sysconfig; print(sysconfig.get_path("include"))')")
for headers in "$(dirname "$torch")"/nvidia/*/include; do
  # -isystem comes after nvcc's own headers; packages may be of another release.
  [ ! -f "$headers/cublas_v2.h" ] && [ ! -f "$headers/cusparse.h" ] && [ ! -f "$headers/cusolverDn.h" ] ||
    includes+=(-isystem "$headers")
done
flags=(-O3 -std=c++20 -DTORCH_EXTENSION_NAME=gsplat_cuda -DTORCH_API_INCLUDE_EXTENSION_H -D__CUDA_NO_HALF_OPERATORS__
  -D__CUDA_NO_HALF_CONVERSIONS__ -D__CUDA_NO_BFLOAT16_CONVERSIONS__ -D__CUDA_NO_HALF2_OPERATORS__)
code=${arch/./}
# nvcc may be a script that calls the real one: it says itself where its toolkit is.
toolkit=${CUDA_HOME:-$(nvcc --dryrun -x cu /dev/null 2>&1 | sed -n 's/^#\$ TOP=//p')}

compile() {
  local source=$1 object=$2
  case $source in
    *.cu) nvcc "${flags[@]}" --expt-relaxed-constexpr -use_fast_math -gencode "arch=compute_$code,code=sm_$code" \
      -Xcompiler -fPIC "${includes[@]}" -w -c "$source" -o "$object" ;;
    *) g++ "${flags[@]}" -fPIC -Wno-attributes "${includes[@]}" -I"$toolkit/include" -w -c "$source" -o "$object" ;;
  esac
}

objects=()
for source in "$gsplat"/csrc/*.cu "$gsplat"/csrc/*.cpp "$gsplat/ext.cpp"; do
  name=$(basename "$source")
  # shellcheck disable=SC2053
  [ -z "$only" ] || [[ $name == $only ]] || continue
  object=$output/$name.o
  objects+=("$object")
  [ "$object" -nt "$source" ] && { echo "kept $name" | tee -a "$log"; continue; }
  began=$SECONDS
  if compile "$source" "$object.part" 2>"$output/$name.err"; then
    mv "$object.part" "$object"
    echo "compiled $name: $((SECONDS - began)) s" | tee -a "$log"
  else
    echo "FAILED $name: $(grep -m 1 -i error "$output/$name.err")" | tee -a "$log"
    exit 1
  fi
done
[ -z "$only" ] || exit 0

library=$output/gsplat_cuda.so
g++ -shared "${objects[@]}" -o "$library" -L"$torch/lib" -lc10 -lc10_cuda -ltorch_cpu -ltorch_cuda -ltorch -ltorch_python \
  -L"$toolkit/lib" -L"$toolkit/lib64" -lcudart
# Every symbol that the library needs of torch has to be in torch's libraries: a changed interface shows here.
nm -D --defined-only "$torch"/lib/lib{c10,c10_cuda,torch_cpu,torch_cuda,torch_python}.so | awk 'NF > 2 {sub(/@.*/, "", $3); print $3}' | sort -u >"$output/defined"
missing=$(nm -D --undefined-only "$library" | awk '{sub(/@.*/, "", $2); print $2}' | grep -E '^_ZN?K?(2at|3c10|5torch)' | sort -u | comm -23 - "$output/defined")
if [ -n "$missing" ]; then
  echo "FAILED link: torch lacks $(echo "$missing" | head -n 3 | c++filt | tr '\n' ';')" | tee -a "$log"
  exit 1
fi
echo "linked $library for sm_$code: $(stat -c %s "$library") bytes, no symbol of torch missing" | tee -a "$log"
