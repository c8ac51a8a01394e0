"""A test may be skipped only for a reason listed here; any other skip fails the run."""

import signal

import pytest
from hypothesis import HealthCheck, settings

# the speed and load of a machine are not properties of the code
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")

ALLOWED = (
    "could not import 'envpool'",  # 800 MB that only test-newest and test-oldest install
    "no results",  # benchmarks/results is filled by hand-started measurements
    "needs a cache",  # TIGHTROPE_NUMBA_CACHE=off
)
_unexpected: list[str] = []

# a shell starts background commands with SIGINT ignored, and processes that tests start would inherit that
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        if not any(allowed.lower() in reason.lower() for allowed in ALLOWED):
            _unexpected.append(f"{report.nodeid}: {reason}")


def pytest_sessionfinish(session: pytest.Session) -> None:
    if _unexpected and not hasattr(session.config, "workerinput"):
        print("\nskipped without a listed reason:\n" + "\n".join(_unexpected))
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
