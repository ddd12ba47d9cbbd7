#!/bin/sh
# Runs on the grid world that are killed, repeated and watched. Run by `make endure`, from the root of the repository.
#   kills        each run is killed with SIGKILL at random times and continued by the same command until it is done; its
#                folder must then hold the bytes of an undisturbed run. KILLS=500 in all; SEED=N of the times
#   determinism  each run by 1, 2, 3 and 8 threads, and again: the same bytes
#   memory       a training of SECONDS_LONG=20 seconds: in its second half neither the resident memory (VmRSS) nor the
#                number of open files may exceed the first half's by more than 2 % and 0
# Exit status 1 if anything is wrong.
set -eu
kills=${KILLS:-500} seed=${SEED:-$(date +%s)} seconds=${SECONDS_LONG:-20}
work=build/endure
wodtem=$PWD/wodtem
rm -rf $work
mkdir -p $work
cd $work
wrong=0
bad() {
    echo "WRONG: $*"
    wrong=$((wrong + 1))
}

tiny="--set width=16 --set heads=2 --set layers=1 --set batch_size=16 --set data_trajectories=50 --set buffer_size=30"
online="--set offline_updates=100 --set online_steps=3000 --set updates_per_iteration=10 --set eval_every=5"
run() { # METHOD FOLDER OPTIONS...
    method=$1 out=$2
    shift 2
    [ $method = dt ] && options="--set offline_updates=1500" || options=$online
    exec nice -n 5 "$wodtem" train gridworld --method $method --seed 7 $tiny $options --out $out "$@"
}
now() { date +%s.%N; }

for method in dt odt wodtem; do
    began=$(now)
    (run $method whole-$method --threads 1) > log 2>&1
    echo "$began $(now)" | awk '{ print $2 - $1 }' > length-$method
done

echo "kills: seed $seed (give it back with: make endure SEED=$seed)"
# Each line: the time, as a share of the longest; threads; --checkpoint-every.
awk -v seed="$seed" -v n="$kills" 'BEGIN {
    srand(seed)
    for (i = 0; i < 3 * n; ++i) print rand(), int(3 * rand()) + 1, int(2 * rand())
}' > times
done_kills=0 runs=0 temporaries=0 share=0
exec 3< times
while [ $done_kills -lt "$kills" ] && [ -n "$share" ]; do  # one in three may end too soon for its kill
    for method in dt odt wodtem; do
        rm -rf r
        mine=0 status=1
        while [ $status != 0 ]; do
            if [ $mine -lt 20 ]; then read -r share threads every <&3 || share=; fi
            if [ $mine -ge 20 ] || [ -z "$share" ]; then # enough: it may end
                (run $method r) > log 2>&1 || bad "$method, after $mine kills: $(tail -n 1 log)"
                break
            fi
            (run $method r --threads $threads --checkpoint-every $every) > log 2>&1 &
            pid=$!
            sleep "$(awk -v x="$share" '{ print 0.8 * x * x * $1 }' length-$method)"
            kill -9 $pid 2> /dev/null || true
            status=0
            wait $pid 2> /dev/null || status=$?
            case $status in
                0) ;;
                137) mine=$((mine + 1)) ;;
                *) bad "$method, after $mine kills, exit status $status: $(tail -n 1 log)"; break ;;
            esac
            ls r/*.tmp > /dev/null 2>&1 && temporaries=$((temporaries + 1))
        done
        runs=$((runs + 1)) done_kills=$((done_kills + mine))
        diff -r -x seconds.csv whole-$method r > differences || bad "$method, after $mine kills: $(head -n 1 differences)"
        [ $done_kills -lt "$kills" ] || break
    done
done
echo "kills: $done_kills, $runs runs ended, a temporary lay there after $temporaries kills"

count=0
for method in dt odt wodtem; do
    for threads in 1 2 3 8 1 2; do
        rm -rf r
        (run $method r --threads $threads) > log 2>&1 || bad "$method, $threads threads: $(tail -n 1 log)"
        diff -r -x seconds.csv whole-$method r > differences || bad "$method, $threads threads: $(head -n 1 differences)"
        count=$((count + 1))
    done
done
echo "determinism: $count runs by 1, 2, 3 and 8 threads"

rm -rf r
online="--set offline_updates=100 --set online_steps=100000000 --set eval_every=5"
(run wodtem r --threads 2 --checkpoint-every 1) > log 2>&1 &
pid=$!
sleep 2
i=0
while [ $i -lt $((5 * seconds)) ] && [ -d /proc/$pid ]; do
    echo "$(awk '/VmRSS/ { print $2 }' /proc/$pid/status) $(ls /proc/$pid/fd | wc -l)"
    sleep 0.2
    i=$((i + 1))
done > samples
kill $pid 2> /dev/null || true
wait $pid || true
grep -q 'everything is saved' log || bad "memory: the training did not end as asked: $(tail -n 1 log)"
awk '{ memory[NR] = $1; files[NR] = $2 }
     END {
         for (i = 1; i <= NR; ++i) {
             half = i > NR / 2
             if (memory[i] > most[half]) most[half] = memory[i]
             if (files[i] > open[half]) open[half] = files[i]
         }
         printf "memory: at most %d and %d kB resident, %d and %d open files in the two halves of %d samples\n",
                most[0], most[1], open[0], open[1], NR
         exit NR < 10 || most[1] > 1.02 * most[0] || open[1] > open[0]
     }' samples || bad "memory: it grows"
echo "$wrong wrong"
[ $wrong = 0 ]
