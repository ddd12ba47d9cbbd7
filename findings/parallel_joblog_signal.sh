#!/bin/sh
# GNU parallel 20221122 (Debian 12, parallel 20221122+ds-2): in the joblog of a sweep, a job that was killed by a signal
# has Exitval 0. Only the next column, Signal, tells it from a job that succeeded, so a script that looks for a non-zero
# Exitval counts killed trainings as finished. --resume-failed looks at both columns and runs the job again.
#
# Output seen on 2026-11-29:
#   Exitval 0 Signal 9: the killed job
#   Exitval 0 Signal 0: the job that ended
#   after --resume-failed the killed job has run 2 times, the other 1 time
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
apt-get download -qq parallel=20221122+ds-2 >/dev/null
dpkg-deb -x parallel_*.deb package
parallel="perl $folder/package/usr/bin/parallel --will-cite --jobs 1 --joblog log"
# The first job counts its runs and kills itself the first time; the second only counts.
cat > first <<'JOB'
echo run >> first.runs
if [ "$(wc -l < first.runs)" = 1 ]; then kill -9 $$; fi
JOB
printf 'exec sh ./first\necho run >> second.runs\n' > jobs
$parallel < jobs > /dev/null 2>&1 || true
killed=$(awk '$1 == 1 {print "Exitval " $7 " Signal " $8}' log)
ended=$(awk '$1 == 2 {print "Exitval " $7 " Signal " $8}' log)
echo "$killed: the killed job"
echo "$ended: the job that ended"
$parallel --resume-failed < jobs > /dev/null 2>&1
echo "after --resume-failed the killed job has run $(wc -l < first.runs) times, the other $(wc -l < second.runs) time"
test "$killed" = "Exitval 0 Signal 9" && test "$ended" = "Exitval 0 Signal 0"
test "$(wc -l < first.runs)" = 2 && test "$(wc -l < second.runs)" = 1
