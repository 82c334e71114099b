"""Processes and the wire: server, client, stage node, recorder, viewer stream, command line."""
