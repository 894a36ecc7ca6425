import json
import resource
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, "tests")
from multiprocessing.forkserver import _forkserver

from soak.proof import measure
from soak.rows import row_of
from soak.tally import Form

if __name__ == "__main__":
    n = int(sys.argv[1])
    with tempfile.TemporaryDirectory() as f:
        r = measure(
            row_of(n),
            Form(long=len(sys.argv) > 3 and sys.argv[3] == "long", seed=int(sys.argv[2])),
            Path(f),
        )
    _forkserver._stop()
    a = resource.getrusage(resource.RUSAGE_CHILDREN)
    b = resource.getrusage(resource.RUSAGE_SELF)
    r["cpu"] = a.ru_utime + a.ru_stime + b.ru_utime + b.ru_stime
    print(json.dumps(r, indent=1))
