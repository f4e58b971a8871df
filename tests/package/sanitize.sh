#!/usr/bin/env bash
# Runs tests on the C library built with AddressSanitizer and UndefinedBehaviorSanitizer: reading
# or writing beside an array, or undefined arithmetic, ends the run with the line at fault.
#
#     tests/package/sanitize.sh [pytest arguments]
#
# Needs gcc or clang with its sanitizer libraries, and a Python with NumPy and the extra `test`.
set -euo pipefail
checkout=$(cd "$(dirname "$0")/../.." && pwd)
python=${PYTHON:-python3}
cc=${CC:-gcc}

folder=$(mktemp -d)
# Reports go to files: pytest would keep to itself what a test that ends the process has written.
trap 'cat "$folder"/report.* 2>/dev/null; rm -rf "$folder"' EXIT
cp -r "$checkout/generated" "$checkout/runtime" "$checkout/tests" "$checkout/pyproject.toml" "$folder"
find "$folder" -name '*.so' -delete

# One library, for the baseline: its sources are those of every processor level.
cd "$folder"
flags="-std=c99 -g1 -fno-var-tracking -O1 -ffp-contract=off -fopenmp-simd -fno-math-errno -fno-trapping-math -fPIC
       -fvisibility=hidden -fno-omit-frame-pointer
       -fsanitize=address,undefined -fno-sanitize-recover=undefined"
for source in generated/c/*.c runtime/c/*.c; do
    echo "$source"
done | xargs -P "$(nproc)" -I{} sh -c \
    "$cc $(echo $flags) -Igenerated/c -Iruntime/c -c {} -o \$(echo {} | tr / _).o"
$cc -shared -fsanitize=address,undefined ./*.o -lm \
    -o generated/epigauge_generated/c_backend/libepigauge_kernels.so

# The C++ library, too, since those that Python loads later (OpenCV) throw exceptions.
export LD_PRELOAD
LD_PRELOAD="$($cc -print-file-name=libasan.so) $($cc -print-file-name=libstdc++.so)"
# Python itself leaves memory to the system at exit, which is no leak of the library's.
export ASAN_OPTIONS=detect_leaks=0:log_path=$folder/report
export UBSAN_OPTIONS=print_stacktrace=1:log_path=$folder/report
# Python's and NumPy's own pools would hide what lies beside an array.
export PYTHONMALLOC=malloc
export OPENBLAS_NUM_THREADS=1
export PYTHONPATH="$folder/runtime:$folder/generated:$folder/tests"
export EPIGAUGE_DATA=${EPIGAUGE_DATA:-$checkout/../shared/data}
"$python" -c 'import epigauge; assert epigauge.backend() == "c", epigauge.backend()'
"$python" -m pytest -q -p no:cacheprovider "$@"
