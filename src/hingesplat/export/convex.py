"""CoACD in a process of its own: it ends the process that calls it on some meshes, and no run should end so.

``python convex.py IN.npz OUT.npz`` cuts ``vertices`` (n, 3) and ``faces`` (m, 3); ``options`` is JSON for CoACD. It
imports nothing of hingesplat, so that it starts at once.
"""

import json
import sys

import coacd
import numpy as np


def main(source: str, target: str) -> None:
    with np.load(source, allow_pickle=False) as data:
        vertices, faces, options = data["vertices"], data["faces"], json.loads(str(data["options"]))
    coacd.set_log_level("error")
    pieces = coacd.run_coacd(coacd.Mesh(vertices, faces), **options)
    np.savez(target, allow_pickle=False, **{f"{i:03d}": np.asarray(points) for i, (points, _) in enumerate(pieces)})


if __name__ == "__main__":
    main(*sys.argv[1:])
