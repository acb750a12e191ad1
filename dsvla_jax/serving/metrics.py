"""What the server counts, in Prometheus' text format."""

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

_SECONDS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)


class Metrics:
    """The counters of one server, apart from those of any other in the process."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        outcomes = "Requests by outcome: answered, bad, timed_out, failed"
        self.requests = Counter("dsvla_requests", outcomes, ["outcome"], registry=self._registry)
        self.latency = Histogram(
            "dsvla_request_seconds", "From a request read to its answer sent", buckets=_SECONDS, registry=self._registry
        )
        self.answering = Histogram(
            "dsvla_batch_seconds", "The policy's time for a batch", buckets=_SECONDS, registry=self._registry
        )
        self.batch = Histogram(
            "dsvla_batch_robots", "Requests in a batch", buckets=(1, 2, 4, 8, 16, 32, 64), registry=self._registry
        )
        self.connections = Gauge("dsvla_connections", "Open connections", registry=self._registry)
        self.ready = Gauge("dsvla_ready", "1 once everything is compiled", registry=self._registry)

    def text(self) -> str:
        """The page for Prometheus."""
        return generate_latest(self._registry).decode()
