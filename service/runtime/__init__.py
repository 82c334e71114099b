"""Parts of every process of the service: sessions, delivery of messages, memory, a clean stop, logging.

`open_client`, `open_service` and `open_router` open zenoh sessions, `StopSignal` ends a process on a signal,
`set_up_logging` formats the log.
"""
