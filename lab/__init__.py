"""Experiments on the service: demonstration, soak, scenarios, rehearsal, and the chapter reproduced."""
