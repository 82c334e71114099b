"""Access to a service: who is believed, who commands, and who may connect at all (docs/access.md).

`authenticator` signs what is said on the wire and checks it; `tokens` are the signed liveliness tokens of instances and
controllers, and `lease` lets one controller at a time command. `access` makes and checks what zenoh needs beyond one
machine: TLS and roles; `refusals` counts what zenoh refuses.
"""
