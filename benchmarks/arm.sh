#!/usr/bin/env bash
# Runs the CPU kernels' tests as programs for 64-bit ARM under QEMU, on a Debian or Ubuntu machine of another kind.
#
#     apt install qemu-user-static mmdebstrap
#     benchmarks/arm.sh [--folder DIR] [TESTS] [OPTIONS OF PYTEST]              tests/rasterize, if no TESTS are named first
#     QEMU_CPU=neoverse-n1 NUMBA_CPU_NAME=neoverse-n1 benchmarks/arm.sh         that processor, and kernels for it
#
# The first call makes DIR (arm-emulated): a Python of the distribution's, extracted for arm64, and wheels for it, 1.2 GB.
# Without NUMBA_CPU_NAME the kernels are compiled for any ARMv8 processor: LLVM finds out about this machine's
# processor from /proc/cpuinfo, which QEMU 7 does not emulate. Compiled kernels stay in DIR/kernels.
# pycolmap has no wheels for Linux on ARM. A stand-in lets the tests be imported, but what needs pycolmap fails.
set -euo pipefail

folder=arm-emulated
while [ $# -gt 0 ]; do
  case $1 in
    --folder) folder=$2; shift 2 ;;
    -h | --help) sed -n '2,11p' "${BASH_SOURCE[0]}"; exit 0 ;;
    *) break ;;
  esac
done
mkdir -p "$folder"
folder=$(cd "$folder" && pwd)
source=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

# Extracted only: nothing in it has to run, so that neither root's rights nor binfmt_misc are needed.
if [ ! -e "$folder/root/usr/bin/python3" ]; then
  mmdebstrap --variant=extract --architectures=arm64 --include=python3,libpython3-stdlib,libstdc++6 \
    "$(. /etc/os-release && echo "$VERSION_CODENAME")" "$folder/root"
fi
version=$(readlink "$folder/root/usr/bin/python3")
version=${version#python}

if [ ! -e "$folder/complete" ]; then
  fetch=(python3 -m pip install --target "$folder/site" --upgrade --no-compile --only-binary :all: --python-version "$version")
  for platform in manylinux2014 manylinux_2_17 manylinux_2_27 manylinux_2_28 manylinux_2_31; do
    fetch+=(--platform "${platform}_aarch64")
  done
  "${fetch[@]}" 'numba>=0.61,<0.69' numpy scipy pillow safetensors filelock jaxtyping beartype pyyaml tqdm transformers tyro \
    rich pytest pytest-timeout pytest-xdist hypothesis sympy networkx jinja2 fsspec setuptools \
    tensorboard
  # Alone, because pip reads its dependencies as those of this machine. From 2.11 on, it needs CUDA.
  "${fetch[@]}" --no-deps 'torch>=2.8,<2.11'
  cat >"$folder/site/pycolmap.py" <<'END'
def __getattr__(name):
    if name.startswith("__"):
        raise AttributeError(name)
    return type(name, (), {})
END
  touch "$folder/complete"
fi

[[ ${1:--} != -* ]] || set -- tests/rasterize "$@"
cd "$source"
export QEMU_LD_PREFIX=$folder/root PYTHONPATH=$folder/site:$source/src PYTHONPYCACHEPREFIX=$folder/bytecode
export NUMBA_CACHE_DIR=$folder/kernels PYTHONNOUSERSITE=1
# A name without features would be combined with those of this machine's processor.
[ -z "${NUMBA_CPU_NAME:-}" ] || export NUMBA_CPU_FEATURES=${NUMBA_CPU_FEATURES-+neon}
exec qemu-aarch64-static "$folder/root/usr/bin/python3" -m pytest -n0 -o timeout=3000 -p no:cacheprovider "$@"
