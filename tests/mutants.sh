#!/bin/sh
# Which of the mistakes in tests/mutants.txt do the golden vectors and the tests find? Run by `make mutants`, from the
# root of the repository.
#
# A copy of the sources in build/mutants gets all of them at once, each behind a switch: where the list says
#   e[entry] < d ==> e[entry] <= d     the copy says     (mutant == 7 ? (e[entry] <= d) : (e[entry] < d)),
# and the environment variable MUTANT switches one on: one build serves them all. Each mistake is first put before
# `wodtem check` with all golden vectors, and, if that passes, before the tests whose names hold its name, then all tests.
set -eu
work=build/mutants
rm -rf $work
mkdir -p $work
cp -r Makefile README.md ./*.hpp ./*.cpp data tests $work

# Writes the copies. Text must occur exactly once; of changes that overlap, one must hold the others.
awk -v work=$work '
function slurp(path,   text, line) {
    while ((getline line < path) > 0) text = text line "\n"
    close(path)
    return text
}
function stop(why) { print "tests/mutants.txt:" NR ": " why > "/dev/stderr"; failed = 1 }
/^#/ || /^$/ { next }
{
    if (!match($0, /^[a-zA-Z0-9_\/]+: [a-z0-9_.\/]+: /)) { stop("expected NAME: FILE: CODE"); next }
    split(substr($0, 1, RLENGTH), field, ": ")
    file = field[2]
    rest = substr($0, RLENGTH + 1)
    gsub(/\\n/, "\n", rest)
    open = index(rest, "<<<"); arrow = index(rest, " ==> "); shut = index(rest, ">>>")
    if (!open || arrow < open || shut < arrow) { stop("expected ...<<<OLD ==> NEW>>>..."); next }
    before = substr(rest, 1, open - 1); old = substr(rest, open + 3, arrow - open - 3)
    new = substr(rest, arrow + 5, shut - arrow - 5); after = substr(rest, shut + 3)
    if (!(file in text)) text[file] = slurp(file)
    at = index(text[file], before old after)
    if (!at) { stop("not in " file ": " before old after); next }
    if (index(substr(text[file], at + 1), before old after)) { stop("more than once in " file ": " before old after); next }
    ++count
    of[count] = file; from[count] = at + length(before); to[count] = from[count] + length(old); version[count] = new
    print count " " field[1] > (work "/list.txt")
}
END {
    if (failed) exit 1
    for (file in text) {
        n = 0
        for (k = 1; k <= count; ++k)
            if (of[k] == file) order[++n] = k
        for (i = 1; i <= n; ++i)  # by place, of those that begin together the longest first
            for (j = i + 1; j <= n; ++j)
                if (from[order[j]] < from[order[i]] || (from[order[j]] == from[order[i]] && to[order[j]] > to[order[i]])) {
                    swap = order[i]; order[i] = order[j]; order[j] = swap
                }
        out = ""
        done = 1
        for (i = 1; i <= n; i = j) {  # i is the longest of its place, i + 1 to j - 1 lie within
            first = from[order[i]]; last = to[order[i]]
            out = out substr(text[file], done, first - done) "("
            for (j = i; j <= n && from[order[j]] < last; ++j) {
                k = order[j]
                if (to[k] > last) { print "change " k " of tests/mutants.txt overlaps another"; exit 1 }
                out = out "mutant == " k " ? (" substr(text[file], first, from[k] - first) "(" version[k] ")" \
                      substr(text[file], to[k], last - to[k]) ") : "
            }
            out = out "(" substr(text[file], first, last - first) "))"
            done = last
        }
        printf "%s", out substr(text[file], done) > (work "/" file)
    }
}' tests/mutants.txt
echo '#include <cstdlib>
inline const int mutant = std::getenv("MUTANT") ? std::atoi(std::getenv("MUTANT")) : 0;' > $work/mutant.hpp
if [ "${1:-}" = apply ]; then exit 0; fi
make -C $work -j2 CXXFLAGS='-std=c++20 -O1 -w -pthread -ffp-contract=off -fno-math-errno -include mutant.hpp' \
    wodtem build/tests > $work/build.log 2>&1 || { tail -20 $work/build.log; exit 1; }
cp -r ./*.hpp ./*.cpp data tests $work  # tests that read the sources read the right ones
rm $work/mutant.hpp

cd $work
for command in './wodtem check tests/vectors/*.safetensors' build/tests; do
    sh -c "$command" > log 2>&1 || { tail -20 log; echo "without a mistake this fails: $command"; exit 1; }
done
by_check=0 by_tests=0 survivors=0 meant=0
while read -r number name; do
    export MUTANT="$number"
    topic=${name%%/*} found=0
    timeout 60 ./wodtem check tests/vectors/*.safetensors > log 2>&1 || found=$?
    if [ $found != 0 ]; then
        by_check=$((by_check + 1))
        bad=$(grep -o '[a-z0-9_-]*\.safetensors.*' log | grep -v ' 0 failed' | sed 's/\.safetensors.*//' | sort -u | tr '\n' ' ')
        case " $bad" in *" $topic"*) meant=$((meant + 1)) ;; esac
        echo "$name: wodtem check: ${bad:-stops (status $found)}"
        continue
    fi
    part=${name##*/}
    timeout 120 build/tests "$part" > log 2>&1 && found=0 || found=$?
    if ! grep -q FAILED log && [ $found -le 1 ]; then timeout 900 build/tests > log 2>&1 && found=0 || found=$?; fi
    if [ $found != 0 ]; then
        by_tests=$((by_tests + 1))
        echo "$name: tests: $(grep FAILED log | sed 's/FAILED //' | tr '\n' ' ')"
    else
        survivors=$((survivors + 1))
        echo "$name: SURVIVES"
    fi
done < list.txt
echo "$((by_check + by_tests + survivors)) mistakes: $by_check found by wodtem check ($meant in the file that is meant to)," \
    "$by_tests more by the tests, $survivors not found"
