"""The viewer stream: what a running service does, drawn in the Rerun viewer or kept in an ``.rrd`` file.

``feed`` holds the records, ``join`` pairs samples with references, ``scene`` turns records into curves (with ``trail``,
the last samples of a unit, and ``values``, what a peer's JSON holds) on a ``canvas``, ``blueprint`` says where they
stand, ``rerun_sink`` is the one module that knows Rerun, ``output`` runs it in a process of its own behind a bounded
queue, ``consumer`` fills that queue from zenoh, ``offline`` feeds the same scene from arrays.
"""
