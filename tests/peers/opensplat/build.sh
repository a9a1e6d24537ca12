#!/usr/bin/env bash
# Builds the OpenSplat peer of `raster_bench`: build.sh OPENSPLAT PYTHON OUT
# OPENSPLAT: a checkout of OpenSplat (AGPL-3.0; not part of this program). PYTHON: one with PyTorch, whose libtorch is
# linked. OUT: the program to write; pass it to `raster_bench --peer-opensplat OUT`.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
torch=$("$2" -c 'import os, torch; print(os.path.dirname(torch.__file__))')
abi=$("$2" -c 'import torch; print(int(torch._C._GLIBCXX_USE_CXX11_ABI))')
g++ -O3 -march=native -std=c++20 -D_GLIBCXX_USE_CXX11_ABI="$abi" \
  -I"$1/rasterizer" -I"$torch/include" -I"$torch/include/torch/csrc/api/include" \
  "$here/main.cpp" "$1/rasterizer/gsplat-cpu/gsplat_cpu.cpp" \
  -L"$torch/lib" -Wl,-rpath,"$torch/lib" -Wl,--no-as-needed -ltorch -ltorch_cpu -lc10 -o "$3"
