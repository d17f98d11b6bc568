"""The entry's own process: reads what is asked, runs the estimator, writes what it found."""

from pathlib import Path

from leaderboard.evaluation.entry import EntryError, reconstruct_all, said
from leaderboard.sandbox import messages
from leaderboard.sandbox.messages import Answer, Ask, Training


def run(folder: Path) -> None:
    """Do what `folder` asks and leave an answer there, whatever the estimator does."""
    try:
        answer = _answer(folder, messages.read_ask(folder))
    except EntryError as error:
        answer = Answer(failure=str(error))
    except BaseException as error:
        answer = Answer(failure=said(error))
    messages.write_answer(folder, answer)


def _answer(folder: Path, ask: Ask) -> Answer:
    from leaderboard.evaluation.entries import describe, make

    try:
        estimator = make(ask.reference, ask.settings)
        if ask.car is None:
            return Answer(description=describe(ask.reference, estimator))
    except Exception as error:
        raise EntryError(f"it cannot be made: {said(error)}") from error
    training, tests, car = messages.read_drives(folder, ask)
    trainings = []
    for outcome in reconstruct_all(estimator, training, tests, car, ask.seeds):
        messages.write_estimates(folder, outcome.seed, outcome.estimates)
        told = Training(
            seed=outcome.seed,
            train_seconds=outcome.train_seconds,
            estimate_seconds=outcome.estimate_seconds,
            parameters=outcome.parameters,
        )
        trainings.append(told)
    return Answer(trainings=tuple(trainings))
