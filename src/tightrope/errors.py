"""The base of every error class of this package.

    TightropeError                      Exception
    ├── UsageError                      ValueError          the command line is wrong
    ├── CheckpointError                 ValueError          a checkpoint is damaged or missing
    ├── CannotWrite                     OSError             a file cannot be written
    ├── RunInUse                        RuntimeError        another process writes this run
    ├── NonFiniteError                  FloatingPointError  a NaN or an infinity before an optimiser step
    ├── BadNumbers                      ValueError          a NaN or an infinity from an environment
    ├── SamplingMismatch                RuntimeError        sampling and training disagree on probabilities
    ├── OutOfMemory                     RuntimeError        memory ran out during an update
    ├── DoesNotFit                      ValueError          a job needs more memory than there is
    ├── EnvironmentFault                RuntimeError        an environment failed, hung or died
    ├── ApiBreak                                            internal: becomes an EnvironmentFault
    ├── WrongWeights                    ValueError          weights of a model are missing, or do not fit
    ├── RewardError                     ValueError          a reward function cannot be used
    └── NoScores                                            internal: becomes a masked sample

Each class also inherits the builtin beside it, so ``except ValueError`` still catches what it caught. A
setting or an argument with a wrong value raises a plain ValueError, as in the standard library.

Two classes are not errors and stay outside: `runs.signals.Stopped` (a KeyboardInterrupt) and
`EnvironmentTimeout` (a BaseException). They end a run or a call from outside. ``except Exception`` in the
code of a user must not catch them, and neither must ``except TightropeError``.
"""

__all__ = ["TightropeError"]


class TightropeError(Exception):
    """An error that tightrope raises itself. Its message is for the user: what was seen, what to do."""
