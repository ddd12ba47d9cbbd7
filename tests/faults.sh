#!/bin/sh
# What does the program do when the system says no? Run by `make faults`, from the root of the repository.
#
# Each scenario is run once for every call of a kind that it makes (open, write, ..., allocations), and that call fails
# (tests/faults.c). Then must hold:
#   - the program ends by itself, with status 0 and the files and the output of an undisturbed run, or with status 1 and
#     a sentence on stderr that begins with "wodtem: ";
#   - no temporary file stays, and a file that is written as a whole is the old one or the new one;
#   - the same command, undisturbed, then ends with the files of an undisturbed run; a checkpoint is not lost.
# The table: how many calls a scenario makes, how many of them were made to fail, after how many of these the program
# ended with status 1, and what was wrong. Exit status 1 if anything is wrong, or nothing was tried.
#   FAST=1                                   one call of each kind and 4 allocations, spread evenly
#   ALLOCATIONS=N                            at most N allocations a row
#   FAULTS="open EACCES, malloc ENOMEM"      these rows alone
#   SCENARIOS="train, new|info"              these scenarios alone
set -eu
calls=1000000000 allocations=${ALLOCATIONS:-$calls}
if [ "${FAST:-}" ]; then calls=1 allocations=4; fi
work=build/faults
wodtem=$PWD/wodtem
rm -rf $work
mkdir -p $work/nothing $work/old
${CC:-gcc} -O1 -Wall -Wextra -shared -fPIC tests/faults.c -o $work/faults.so -ldl
cd $work
faults="open EACCES, open EINTR, write ENOSPC, write FULL, write EINTR, write SHORT, fsync EIO, rename EIO,
        close EIO, read EIO, read EINTR, read SHORT, ftruncate EIO, unlink EIO, mkdir ENOSPC, mmap ENOMEM,
        thread EAGAIN, malloc ENOMEM, malloc FULL"
faults=${FAULTS:-$faults}

with_fault() { # "CALL HOW N" COMMAND...
    call_how_n=$1
    shift
    timeout 60 env FAULT="$call_how_n" FAULT_COUNT=count LD_PRELOAD="$PWD/faults.so" "$wodtem" "$@" > stdout 2> stderr
}

# Prints what is wrong after a fault; nothing if all is well.
problems() { # STATUS CALL COMMAND...
    status=$1 call=$2
    shift 2
    case $status in
        0) diff -r -x seconds.csv good out > differences && cmp stdout good.stdout || echo "status 0, but other bytes" ;;
        1) grep -q '^wodtem: ' stderr || echo "status 1 without a sentence: $(tail -n 1 stderr)" ;;
        *) echo "status $status: $(tail -n 1 stderr)" ;;
    esac
    [ "$call" = unlink ] || find out -name '*.tmp'
    for file in $(cd out && find . -type f); do
        case $file in *.csv | *checkpoint* | *.tmp) continue ;; esac  # logs grow, each checkpoint is another
        cmp -s "out/$file" "good/$file" || cmp -s "out/$file" "$before/$file" || echo "$file is neither old nor new"
    done
    timeout 60 "$wodtem" "$@" > stdout 2> stderr || echo "the next run fails: $(tail -n 1 stderr)"
    diff -r -x seconds.csv good out > differences || echo "the next run makes other files: $(head -n 1 differences)"
    if [ -f "$before/r/checkpoint.safetensors" ] && grep 'starting anew' stderr; then echo "the checkpoint is lost"; fi
}

all=0 all_wrong=0
scenario() { # NAME FOLDER COMMAND...   FOLDER: what is in the folder `out` before
    name=$1 before=$2
    shift 2
    rm -rf out good
    cp -r "$before" out
    "$wodtem" "$@" > good.stdout 2> stderr || { cat stderr; echo "undisturbed, $name fails"; exit 1; }
    mv out good
    case "|${SCENARIOS:-$name}|" in *"|$name|"*) ;; *) return ;; esac
    IFS=,
    for row in $faults; do
        unset IFS
        set -- "$row" "$@"
        fault=$(echo $1)
        shift
        call=${fault% *}
        cp -r "$before" out
        with_fault "$call count 0" "$@" || { cat stderr; echo "undisturbed, $name fails"; exit 1; }
        rm -rf out
        count=$(cat count)
        most=$calls
        if [ "$call" = malloc ]; then most=$allocations; fi
        stride=$(((count + most - 1) / most))
        n=$(((stride + 1) / 2)) tried=0 failed=0 wrong=0
        while [ $n -le $count ] && [ $stride -gt 0 ]; do
            cp -r "$before" out
            status=0
            with_fault "$fault $n" "$@" || status=$?
            problem=$(problems $status "$call" "$@")
            rm -rf out
            [ $status = 0 ] || failed=$((failed + 1))
            tried=$((tried + 1)) n=$((n + stride))
            [ "$problem" ] || continue
            wrong=$((wrong + 1))
            [ $wrong -gt 5 ] || echo "WRONG: $name, $fault $((n - stride)): $problem"
        done
        [ $tried = 0 ] || printf '%-22s %-16s %7d %7d %7d %7d\n' "$name" "$fault" "$count" $tried $failed $wrong
        all=$((all + tried)) all_wrong=$((all_wrong + wrong))
    done
}

tiny="--set width=8 --set heads=1 --set layers=1 --set batch_size=4 --set data_trajectories=3 --set eval_episodes=2
      --set offline_updates=2 --set online_steps=60 --set updates_per_iteration=1 --set eval_every=1"
train="train gridworld --seed 3 --threads 2 --checkpoint-every 0 $tiny"

printf '%-22s %-16s %7s %7s %7s %7s\n' scenario fault calls tried failed wrong
scenario "train, new" nothing $train --out out/r
mkdir out
with_fault "fsync TERM 14" $train --out out/r && exit 1
test -f out/r/checkpoint.safetensors
mv out stopped
scenario "train, continued" stopped $train --out out/r
mv good trained
for file in odt model episodes set; do echo old > old/$file; done
scenario report nothing report trained/r --out out/report
scenario export old export --odt trained/r out/odt
mv good exported
scenario import old import exported/odt out/model
scenario eval old eval trained/r --record out/episodes
if "$wodtem" collect maze2d-umaze --steps 60 --out set.hdf5 > /dev/null 2> stderr; then
    scenario collect old collect maze2d-umaze --steps 60 --out out/set
    scenario info nothing info set.hdf5 --task maze2d-umaze
else
    grep -q MuJoCo stderr
    echo "collect and info: left out, this program is built without MuJoCo"
fi
echo "$all faults, $all_wrong wrong"
[ $all_wrong = 0 ] && [ $all -gt 0 ]
