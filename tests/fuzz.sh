#!/bin/sh
# Fuzzing with libFuzzer: `make fuzz` calls this from the root of the repository, first as
#   fuzz.sh build CLANG++ FLAGS...   makes build/fuzz/fuzz of tests/fuzz.cpp, with the sanitizers for addresses and
#                                    undefined behaviour
#   fuzz.sh run SECONDS TARGET...    runs each target that long, without TARGET all, and prints a line for each;
#                                    MAX_LEN=BYTES bounds the inputs, which libFuzzer else bounds by the seeds
# In the copy that is built no checksum is compared: what a checksum would refuse is what the code behind it shall meet.
# The corpus stays in build/fuzz and grows from run to run; what is found lies in build/fuzz/found. To keep a finding,
# copy it to tests/fuzz/TARGET-WHAT: the tests replay what is there. Exit status 1 if anything was found.
set -eu
work=build/fuzz

replace() { # FILE OLD NEW: OLD, without the characters special to sed, must be there once
    [ "$(grep -cF -- "$2" "$1")" = 1 ] || { echo "tests/fuzz.sh: not once in $1: $2"; exit 1; }
    sed -i "s/$2/$3/" "$1"
}

if [ "$1" = build ]; then
    clang=$2
    shift 2
    rm -rf $work/tree
    mkdir -p $work/tree
    cp -r ./*.hpp ./*.cpp data tests $work/tree
    cd $work/tree
    replace data/hdf5.hpp '= little_endian(data.last(4)) == fletcher32(covered)' '= fletcher32(covered) >= 0'
    replace data/hdf5.hpp 'expect(number(4) == lookup3(covered)' 'expect(number(4) + lookup3(covered) >= 0'
    replace data/hdf5.hpp 'block.expect(stored == lookup3(covered)' 'block.expect(stored + lookup3(covered) >= 0'
    replace data/hdf5.hpp '!= adler32(out)' '< 0 * adler32(out)'
    replace data/safetensors.hpp 'start.substr(crc_at, 8) == header_checksum(start)' '!header_checksum(start).empty()'
    replace data/safetensors.hpp 'require(found == expected' 'require(found.size() == expected.size()'
    replace tests/check.hpp 'products <= 2e9' 'products <= 3e7' # a run is to take less than a second here, too
    "$clang" -DFUZZ -fsanitize=fuzzer,address,undefined -fno-sanitize-recover=all tests/fuzz.cpp -o ../fuzz "$@"
    exit
fi

seconds=$2
shift 2
[ $# != 0 ] || set -- hdf5 inflate safetensors settings checkpoint model import report check command_line
TMPDIR=$(mktemp -d -p /dev/shm wodtem-fuzz-XXXXXX)
export TMPDIR
trap 'rm -rf "$TMPDIR"' EXIT
fuzz=$PWD/$work/fuzz wodtem=$PWD/wodtem root=$PWD
mkdir -p $work/found
cd $work

# Seeds: runs of a second's fraction, checkpoints that they leave when they are told to stop, and what the tests have.
if [ ! -d seeds ]; then
    mkdir -p runs
    for target in hdf5 inflate safetensors settings checkpoint model import report check command_line; do
        mkdir -p seeds.new/$target
    done
    ${CC:-gcc} -O1 -shared -fPIC "$root/tests/faults.c" -o faults.so -ldl
    for method in dt odt wodtem; do
        train="train gridworld --method $method --threads 1 --checkpoint-every 0 --set width=8 --set heads=1
               --set layers=1 --set batch_size=2 --set data_trajectories=2 --set eval_episodes=1"
        train="$train --set offline_updates=2"
        if [ $method != dt ]; then
            train="$train --set online_steps=90 --set updates_per_iteration=1 --set eval_every=1"
        fi
        "$wodtem" $train --out runs/$method > log 2>&1
        for nth in 8 12 20; do
            FAULT="fsync TERM $nth" LD_PRELOAD=$PWD/faults.so "$wodtem" $train --out runs/stopped > log 2>&1 || true
            file=runs/stopped/checkpoint.safetensors
            [ ! -f $file ] || cp $file seeds.new/checkpoint/$method-$nth
            rm -rf runs/stopped
        done
        cp runs/$method/settings seeds.new/settings/$method
        for target in model import safetensors; do cp runs/$method/model.safetensors seeds.new/$target/$method; done
        for file in settings progress.csv episodes.csv policy.csv start_actions.csv; do
            cat runs/$method/$file
            printf '\0'
        done > seeds.new/report/$method
    done
    for file in "$root"/tests/vectors/*.safetensors; do
        [ "$(wc -c < "$file")" -gt 40000 ] || cp "$file" seeds.new/check
    done
    for file in "$root"/tests/hdf5/*.z; do # a size, then a zlib stream: with its header exchanged it is one of gzip
        name=$(basename "$file" .z)
        cp "$file" seeds.new/inflate/$name
        seed=seeds.new/hdf5/$name
        { printf '\037\213\010\0\0\0\0\0\0\0'; tail -c +11 "$file"; } | gzip -dc 2> /dev/null > $seed || true
    done
    find seeds.new -size +200k -delete
    for file in "$root"/tests/fuzz/*; do
        name=$(basename "$file")
        cp "$file" "seeds.new/${name%%-*}/$name"
    done
    for command in train eval collect sweep; do "$wodtem" $command --help; done |
        grep -o -e '--[a-z-]*' -e '^  [a-z_]*' | tr -d ' ' | sort -u | grep . | sed 's/.*/"&"/' > words
    mv seeds.new seeds
fi

found=0
printf '%-14s %10s %8s %8s   %s\n' target executions edges inputs finding
for target; do
    mkdir -p corpus/$target
    status=0
    FUZZ_TARGET=$target "$fuzz" corpus/$target seeds/$target -dict=words -max_total_time="$seconds" -timeout=1 \
        -max_len="${MAX_LEN:-0}" -malloc_limit_mb=256 -rss_limit_mb=1024 -print_final_stats=1 \
        -artifact_prefix=found/$target- > log-$target 2>&1 || status=$?
    line=$(grep -a 'cov: ' log-$target | tail -n 1)
    finding=
    if [ $status != 0 ]; then
        found=$((found + 1))
        finding=$(grep -a -m 1 -e '^SUMMARY' -e 'what()' log-$target; grep -a -o 'written to .*' log-$target | tail -n 1)
    fi
    executions=$(sed -n 's/^stat::number_of_executed_units: *//p' log-$target)
    edges=$(echo "$line" | sed 's/.*cov: \([0-9]*\).*/\1/') inputs=$(echo "$line" | sed 's/.*corp: \([0-9]*\).*/\1/')
    printf '%-14s %10s %8s %8s   %s\n' $target "$executions" "$edges" "$inputs" "$finding"
done
echo "$found targets with findings"
[ $found = 0 ]
