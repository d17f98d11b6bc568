"""The entry's own process: reads what is asked, runs the estimator, writes what it found."""

from pathlib import Path

from leaderboard.evaluation.entry import EntryError, describe_error, reconstruct_all
from leaderboard.sandbox import messages
from leaderboard.sandbox.messages import Request, Response, TrainingReport


def run(folder: Path) -> None:
    """Do what `folder` asks and leave an answer there, whatever the estimator does."""
    try:
        response = _make_response(folder, messages.read_request(folder))
    except EntryError as error:
        response = Response(failure=str(error))
    except BaseException as error:
        response = Response(failure=describe_error(error))
    messages.write_response(folder, response)


def _make_response(folder: Path, request: Request) -> Response:
    from leaderboard.evaluation.entries import describe, make_estimator

    try:
        estimator = make_estimator(request.reference, request.settings)
        if request.car is None:
            return Response(description=describe(request.reference, estimator))
    except Exception as error:
        raise EntryError(f"it cannot be made: {describe_error(error)}") from error
    training, tests, car = messages.read_drives(folder, request)
    trainings = []
    for training_run in reconstruct_all(estimator, training, tests, car, request.seeds):
        messages.write_estimates(folder, training_run.seed, training_run.estimates)
        told = TrainingReport(
            seed=training_run.seed,
            train_seconds=training_run.train_seconds,
            estimate_seconds=training_run.estimate_seconds,
            parameters=training_run.parameters,
        )
        trainings.append(told)
    return Response(trainings=tuple(trainings))
