"""``uuv profile``: time per stage, throughput, memory, and the real-time loop of one vehicle."""
