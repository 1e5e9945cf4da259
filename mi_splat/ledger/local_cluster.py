"""A Dask cluster of this machine: a scheduler, and workers with one thread each.

`python -m mi_splat.ledger.local_cluster WORKERS MEGABYTES DESCRIPTOR` is the process of
its scheduler. It ends, and all of its workers with it, when who started it ends.
"""

import os
import sys
import tempfile
import threading

import dask.config
from distributed import LocalCluster, Security

from mi_splat.process_group import connection, inbox, log_endings

_SETTINGS = {
    # A nanny whose worker is just being started again must not be given up.
    "distributed.deploy.lost-worker-timeout": "1000 days",
    "distributed.scheduler.allowed-failures": 1 << 30,  # jobs count their own tries
    "distributed.scheduler.no-workers-timeout": "2 minutes",
    "distributed.scheduler.worker-ttl": None,  # a job may be busy for long
    "distributed.worker.profile.enabled": False,
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 1.0,
}


def main() -> int:
    """Start the cluster, tell who started this process how to reach it, and stay."""
    workers, megabytes, descriptor = sys.argv[1:]
    pipe = connection(descriptor)
    inbox(pipe.recv)
    dask.config.set(_SETTINGS)
    log_endings("distributed.nanny")
    # Workers start here: files of the working directory may look like modules.
    os.chdir(tempfile.gettempdir())
    security = Security.temporary()
    with LocalCluster(
        n_workers=int(workers),
        threads_per_worker=1,
        memory_limit=round(float(megabytes) * 1e6),
        protocol="tls://",
        security=security,
        dashboard_address=None,
    ) as cluster:
        pipe.send((cluster.scheduler_address, security))
        threading.Event().wait()
    return 0


if __name__ == "__main__":
    sys.exit(main())
