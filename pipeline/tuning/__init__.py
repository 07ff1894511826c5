"""Hyperparameter studies: the one package that imports Optuna."""
