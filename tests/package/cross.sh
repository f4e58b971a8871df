#!/usr/bin/env bash
# Compiles the C library for other systems than this one with zig's compiler and linker, to see
# that its sources are C that they accept. Nothing is run.
#
#     tests/package/cross.sh [TARGET ...]
#
# Needs a Python with the package `ziglang` (pip install ziglang).
set -euo pipefail
cd "$(dirname "$0")/../.."
python=${PYTHON:-python3}
targets=("$@")
((${#targets[@]})) || targets=(aarch64-linux-gnu.2.17 x86_64-windows-gnu aarch64-macos x86_64-macos)

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for target in "${targets[@]}"; do
    mkdir "$folder/$target"
    for source in generated/c/*.c runtime/c/*.c; do
        echo "$source"
    done | xargs -P "$(nproc)" -I{} sh -c "$python -m ziglang cc -target $target -std=c99 -O1 \
        -ffp-contract=off -fopenmp-simd -fno-math-errno -fno-trapping-math -fPIC -fvisibility=hidden \
        -DEG_SOURCES='\"none\"' -Igenerated/c -Iruntime/c -c {} \
        -o $folder/$target/\$(echo {} | tr / _).o"
    "$python" -m ziglang cc -target "$target" -shared "$folder/$target"/*.o -lm -o "$folder/library"
    echo "$target: $(stat -c %s "$folder/library" 2>/dev/null || stat -f %z "$folder/library") bytes"
done
