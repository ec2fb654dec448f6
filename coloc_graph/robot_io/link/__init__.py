"""The link between robots and coordinator, on zenoh: messages, ordering, clocks, certificates."""
