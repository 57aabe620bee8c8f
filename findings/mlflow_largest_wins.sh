#!/usr/bin/env bash
# In MLflow's database, the latest value of a metric is the largest one of its millisecond.
# Version:   mlflow-skinny 3.17.2 with SQLite
# Source:    mlflow/store/tracking/sqlalchemy_store.py: _compare_metrics compares (step, timestamp,
#            value) to tell whether a metric is more recent.
# Behaviour: of two values with the same step and timestamp (whole milliseconds), the larger is kept as the
#            run's value, whichever was logged last. Search and the page show it.
# Guess:     the last one that was logged.
# Matters:   a score that is corrected downwards, or logged by a loop that is faster than a millisecond or
#            takes one timestamp for its batch, stays at its highest value: a bias upwards, which flatters
#            PSNR and worsens LPIPS.
# Seen:      logged 30.0, then 20.0: the run has 30.0; one millisecond later: 20.0
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install mlflow-skinny==3.17.2 alembic==1.20.1 sqlalchemy==2.1.9
"$work/bin/python" - "$work" <<'PY'
import sys
from mlflow.tracking import MlflowClient

client = MlflowClient(f"sqlite:///{sys.argv[1]}/runs.db")
run = client.create_run(client.create_experiment("scores")).info.run_id
for name, later in (("same", 1000), ("later", 1001)):
    client.log_metric(run, name, 30.0, timestamp=1000, step=0)
    client.log_metric(run, name, 20.0, timestamp=later, step=0)
metrics = client.get_run(run).data.metrics
print(f"logged 30.0, then 20.0: the run has {metrics['same']}; one millisecond later: {metrics['later']}")
sys.exit(metrics != {"same": 30.0, "later": 20.0})
PY
