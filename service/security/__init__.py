"""Who may reach a service, and for what: zenoh's TLS, passwords and access control, written, checked and counted."""
