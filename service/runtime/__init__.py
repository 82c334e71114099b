"""What each process of the service needs: sessions, delivery of messages, memory, a clean stop, logging."""
