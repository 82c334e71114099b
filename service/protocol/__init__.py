"""Payloads, keys and errors of the wire (docs/protocol.md); needs numpy only.

`keys` names the keys, `samples` the payloads of stage and controller, `query` those of a feedforward query, `model` a
snapshot, `delta` a change of it, `container` the body that snapshot, checkpoint and model file share, `errors` the
exceptions and error replies.
"""
