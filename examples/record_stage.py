"""Move the stage of my_stage.py through an excitation and record it, for `dehyst identify`.

python examples/record_stage.py recording.csv
"""

import sys
from pathlib import Path

from my_stage import HIGH_V, LOW_V, RATE_HZ, open_stage

from service.adapters import excitation, record, write_recording

path = Path(sys.argv[1] if len(sys.argv) > 1 else "recording.csv")
with open_stage() as stage:
    recording = record(stage, excitation(LOW_V, HIGH_V, RATE_HZ, duration_s=20.0), progress=print)
write_recording(path, recording)
print(f"{path}: {recording.t_s.size} samples, {recording.y_um.min():.2f} to {recording.y_um.max():.2f} µm")
print(f"{recording.late} more came late and were left out; these at most {recording.worst_late_ms:.2f} ms late")
