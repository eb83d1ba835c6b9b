#!/bin/bash
# Makes all published numbers, in order: results/make/all.sh [ROBOT ...], anymal and cassie if none is named.
# A step is skipped if the last of its files was made by today's sources of kernels, sim, qd and train. What is of a
# new archive or of new controllers with the same sources is made anew once its file is gone.
# Behind a step stands its device time on one H100 (by kind of robot, ANYmal / Cassie, where they differ).
set -euo pipefail
cd "$(dirname "$0")/../.."
python=.venv/bin/python

make_file() { # FILE SCRIPT ROBOT
  if "$python" -m results.make.common "$1"; then
    echo "$1 is of today's sources."
  else
    "$python" -m "results.make.$2" --robot "$3"
  fi
}

robots=("$@")
[ $# -gt 0 ] || robots=(anymal cassie)
for robot in "${robots[@]}"; do
  folder=results/$robot
  make_file "$folder/base.json" base "$robot"                         # 2 min
  make_file "$folder/penalty_ratios.json" penalty_ratios "$robot"     # 1 min
  for part in archive archive_cma_mae independent third; do
    make_file "$folder/$part/curve.json" archive "$robot"             # 60 min: four searches, two of them judged
  done
  make_file "$folder/witness.json" witness "$robot"                   # 10 min
  make_file "$folder/archive/minimal.json" minimal "$robot"           # 10 min
  make_file "$folder/agreement.json" agreement "$robot"               # 20 min, most of it MuJoCo C on 16 cores
  make_file "$folder/search.json" search "$robot"                     # 45 min: 45 searches
  make_file "$folder/crossed.json" crossed "$robot"                   # 25 min: eight searches
  make_file "$folder/search_noise.json" search_noise "$robot"         # 40 min: 18 searches
  make_file "$folder/ablation.json" ablation "$robot"                 # 13 min
  make_file "$folder/rounds.json" rounds "$robot"                     # 150 min: six trainings, nine searches
  make_file "$folder/tables_paper_sizes.json" tables "$robot"         # 40 min: twelve trainings
  make_file "$folder/distances.json" distances "$robot"               # 1 min, no GPU
  make_file "$folder/dose-resolved.json" dose "$robot"                # 5 min
  make_file "$folder/spaces.json" spaces "$robot"                     # 16 min
  make_file "$folder/conditions.json" conditions "$robot"             # 20 min: six searches, which --parts can share
  if [ "$robot" = anymal ]; then
    make_file "$folder/map_training.json" map_training "$robot"       # 35 min: eight searches, six trainings
  fi
  [ -f "sim/robots/$robot/packs/2/pack.json" ] || "$python" -m results.make.pack --robot "$robot" # 12 min: two searches
  make_file "$folder/train_speed.json" train_speed "$robot"           # 1 min; with MJLAB results.make.peer too, 3 min
  if [ "$(nvidia-smi --list-gpus | wc -l)" -gt 1 ]; then
    .venv/bin/torchrun --nproc-per-node 2 -m results.make.train_speed --robot "$robot" # 1 min on two GPUs
    make_file "$folder/scale.json" scale "$robot"                     # 4 min on all GPUs
  fi
  "$python" -m results.make.speed --robot "$robot"                    # 7 min; with BEFORE, a checkout, 6 min more
  [ -z "${BEFORE:-}" ] || "$python" -m results.make.speed --robot "$robot" --against "$BEFORE"
  [ "$robot" != anymal ] || make_file "$folder/first.json" first anymal # 11 min on two cores, alone
done
if [ -n "${PUBLIC:-}" ]; then # a folder with published controllers of others, as results/make/public.toml says
  "$python" -m results.make.public "$PUBLIC"                            # 50 min
  "$python" -m results.make.public "$PUBLIC" --films                    # some minutes, no GPU
  "$python" -m results.make.public "$PUBLIC" --route --only go2-robot-lab # 3 min
  imports=$(ls -td runs/make/*/public | head -1)
  "$python" -m results.make.planted "$imports"/{go2-himloco,lite3-himloco,g1-29-unitree-lab}/robot.toml --seed 1 # 8 min
fi
if [ -n "${ANYDRIVE:-}" ]; then # legged_gym's resources/actuator_nets/anydrive_v3_lstm.pt
  "$python" -m results.make.drive --robot anymal --net "$ANYDRIVE"      # 10 min
fi
"$python" -m tests.bench                                              # 3 min
FAULTLINE_DEVICE=cuda:0 "$python" -m pytest -q -m gpu --record=results/bench/gpu-tests.json # 4 min
"$python" -m results.make.pictures                                    # some minutes, a browser
"$python" -m results.make.docs
