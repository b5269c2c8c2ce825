"""Env-steps per second against the number of envs, on the CPU or a GPU; the result is kept with machine, date and command.

python benchmarks/scale.py --device cpu  --num-envs 64,256,1024
python benchmarks/scale.py --device cuda --num-envs 1024,4096,16384,65536
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent


def main() -> int:
    """Run ``uuv profile`` once per size in a process of its own, print a table, write results/<date>_<device>_scale.json."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--num-envs", default="64,256,1024")
    parser.add_argument("--world", default="pool")
    parser.add_argument("--sensors", default="paper")
    parser.add_argument("--seconds", type=float, default=10.0)
    chosen = parser.parse_args()
    rows, machine = [], {}
    for n in chosen.num_envs.split(","):
        command = [
            sys.executable, "-m", "uuvtai", "profile", "--num-envs", n, "--world", chosen.world, "--sensors", chosen.sensors,
            "--seconds", str(chosen.seconds), "--device", chosen.device, "--json",
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            print(done.stderr, file=sys.stderr)
            return done.returncode
        document = json.loads(done.stdout)
        machine = document["machine"]
        if chosen.device == "cuda":
            import torch

            machine["gpu"] = torch.cuda.get_device_name(0)
        row = document["rows"][0]
        rows.append(row)
        speed = row["env_steps_per_s"]
        print(
            f"{row['num_envs']:>7} envs  {speed['step']:>12,.0f} env-steps/s random  {speed['step_inference']:>12,.0f} tree-driven  "
            f"{row['memory_kb_per_env']:,.0f} kB/env  start {row['compile_s']:.0f} s"
        )
    name = f"{time.strftime('%Y-%m-%d')}_{chosen.device}_scale.json"
    target = HERE / "results" / name
    target.parent.mkdir(exist_ok=True)
    target.write_text(
        json.dumps({"command": " ".join(["python", "benchmarks/scale.py", *sys.argv[1:]]), "machine": machine, "rows": rows}, indent=1)
    )
    print(target)
    return 0


if __name__ == "__main__":
    sys.exit(main())
