"""Move the stage through an excitation and record it, for `dehyst identify`."""

from pathlib import Path

from my_stage import HIGH_V, LOW_V, RATE_HZ, open_stage

from dehyst.service.adapters import excitation, record, write_recording

with open_stage() as stage:
    recording = record(stage, excitation(LOW_V, HIGH_V, RATE_HZ, duration_s=30.0), progress=print)
write_recording(Path("recording.csv"), recording)
print(f"recording.csv: {recording.t_s.size} samples, {recording.y_um.min():.2f} to {recording.y_um.max():.2f} µm; "
      f"{recording.late} more came late and were left out")  # fmt: skip
