"""The stages by name, with a line on each, for help and for messages."""

from __future__ import annotations

STAGES: dict[str, str] = {
    "new": "write a machine file of your own, with comments, to machine.file",
    "configure": "write the experiment's composed configuration to config.yaml",
    "identify": "from a machine's data to its results: all of the stages that belong to it, in one command",
    "generate": "model the machine with ROSS and write its vibration",
    "ingest": "turn measured data into the two files that training reads, and draw them",
    "runup": "fit natural frequencies and damping ratios to a run-up, its ramp modelled",
    "diagnose": "tell which coefficients the data determine: rank, condition number, predicted deviation",
    "senses": "fit the data in every sense of phases and angles, and say which one they choose",
    "design": "choose the runs that would identify best, from what an experimenter can do",
    "choose": "say which model the data ask for: bearing laws, laws with a correction, or a network",
    "tune": "search hyperparameters on held-out speeds, and say which values are the best",
    "promote": "let training use what a study found (tuning.study); what changes is said first",
    "dashboard": "put the committed studies into the database that optuna-dashboard shows",
    "samplers": "compare TPE with other samplers: several studies of each at equal budget",
    "train": "identify the unknown bearing coefficients from the vibration",
    "evaluate": "compare identified with modelled coefficients, and with per-speed least squares",
    "robustness": "train from many initial guesses or seeds at once",
    "compare": "identify the modelled machine by every method, over noise, sensors and number of speeds",
    "predict": "predict vibration never seen, critical speeds and stability with the digital twin",
    "balance": "tell the unbalance behind a vibration, and the correction weights: hole, mass, what remains",
    "verdict": "say whether each coefficient can be trusted, why, and what to do next",
    "export": "write the identified bearings for ROSS, ANSYS, DyRoBeS, XLTRC2, Excel, CSV and JSON",
    "summary": "put the results on one screen and in one picture",
    "report": "write one page (HTML, PDF) with all that was measured, identified and predicted, to send on",
    "check": "hold the metrics of all experiments against conf/thresholds; exit code 1 where one is passed",
}

RESULTS: dict[str, str] = {
    "verdict": "verdicts.json",
    "evaluate": "metrics.json",
    "predict": "prediction.json",
    "summary": "summary.txt",
    "report": "report.html",
}
"""What stage=identify makes of a fit, in this order, and the file that shows that it was made."""
