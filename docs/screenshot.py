"""Takes a picture of an ``.rrd`` in the real Rerun viewer, without a display.

    python docs/screenshot.py RUN.rrd docs/images/demo.png --at 33

Needs a Vulkan driver; where there is no GPU, Mesa's software one will do. On Debian:
``apt-get install mesa-vulkan-drivers libgl1-mesa-dri libvulkan1 libegl1 libxkbcommon-x11-0 libx11-xcb1``.
"""

from __future__ import annotations

import argparse
import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

LAVAPIPE = Path("/usr/share/vulkan/icd.d/lvp_icd.x86_64.json")


def connected(client: Any, port: int, process: subprocess.Popen[bytes]) -> Any:
    """A client of the viewer, as soon as the viewer listens."""
    until = time.monotonic() + 30.0
    while True:
        try:
            with socket.create_connection(("127.0.0.1", port), timeout=1.0):
                return client.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        except OSError:
            if process.poll() is not None or time.monotonic() > until:
                sys.exit("the viewer did not start: is a Vulkan driver installed? Run 'rerun --headless' to see")
            time.sleep(0.1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rrd", type=Path, help="recording to show")
    parser.add_argument("png", type=Path, help="picture to write")
    parser.add_argument("--at", type=float, metavar="T_S", help="time of the stage to show, s (default: the end)")
    parser.add_argument(
        "--port", type=int, default=9899, help="port of the viewer, loopback only (default: %(default)s)"
    )
    parser.add_argument("--settle", type=float, default=4.0, metavar="S", help="wait before the picture, s")
    args = parser.parse_args()
    if not args.rrd.is_file():
        parser.error(f"rrd: {args.rrd} is not a file")

    if "VK_ICD_FILENAMES" not in os.environ and LAVAPIPE.exists():
        os.environ["VK_ICD_FILENAMES"] = str(LAVAPIPE)
    with tempfile.TemporaryDirectory() as runtime:
        os.environ.setdefault("XDG_RUNTIME_DIR", runtime)
        import rerun_cli
        from rerun.experimental import ViewerClient

        # The viewer of this very environment, and on the loopback alone: ViewerClient.spawn listens everywhere.
        binary = Path(rerun_cli.__file__).with_name("rerun")
        command = [str(binary), "--headless", "--bind", "127.0.0.1", "--port", str(args.port), "--hide-welcome-screen"]
        with subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            try:
                viewer = connected(ViewerClient, args.port, process)
                viewer.open(str(args.rrd.resolve()))
                time.sleep(args.settle / 2)
                if args.at is None:
                    viewer.set_time("t_s", play_state="following")
                else:
                    viewer.set_time("t_s", duration=args.at, play_state="paused")
                time.sleep(args.settle / 2)
                args.png.parent.mkdir(parents=True, exist_ok=True)
                args.png.unlink(missing_ok=True)
                viewer.save_screenshot(str(args.png.resolve()))
            finally:
                process.terminate()
    print(f"{args.png}: {args.png.stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
