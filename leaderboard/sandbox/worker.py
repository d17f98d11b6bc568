"""Worker process of an entry: reads the request, runs the estimator, writes the response."""

from pathlib import Path

from leaderboard.evaluation.entry import EntryError, describe_error, reconstruct_all
from leaderboard.sandbox import messages
from leaderboard.sandbox.messages import Request, Response, TrainingReport


def run(folder: Path) -> None:
    """Serve the request in `folder` and write a response there, also if the estimator fails."""
    try:
        response = _make_response(folder, messages.read_request(folder))
    except EntryError as error:
        response = Response(failure=str(error))
    except BaseException as error:
        response = Response(failure=describe_error(error))
    messages.write_response(folder, response)


def _make_response(folder: Path, request: Request) -> Response:
    from estimators import make_estimator
    from leaderboard.evaluation.entries import describe

    try:
        estimator = make_estimator(request.reference, **request.settings)
        if request.car is None:
            return Response(description=describe(request.reference, estimator))
    except Exception as error:
        raise EntryError(f"cannot be constructed: {describe_error(error)}") from error
    training, tests, car = messages.read_drives(folder, request)
    trainings = []
    for training_run in reconstruct_all(estimator, training, tests, car, request.seeds):
        messages.write_estimates(folder, training_run.seed, training_run.estimates)
        report = TrainingReport(
            seed=training_run.seed,
            train_seconds=training_run.train_seconds,
            estimate_seconds=training_run.estimate_seconds,
            parameters=training_run.parameters,
        )
        trainings.append(report)
    return Response(trainings=tuple(trainings))
