"""All methods by name, and what a reader must know to choose one."""

from __future__ import annotations

from pipeline.methods import critical_speeds, kriging, least_squares, multi_frequency, spline
from pipeline.methods.fem_nn import fit_by, fit_laws, fit_trained, improve_paper
from pipeline.methods.method import Method

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method(
            "least_squares",
            "per-speed least squares",
            "Tiwari, Lees, Friswell 2002",
            "nothing",
            least_squares.solve_plain,
        ),
        Method(
            "least_squares_expanded",
            "per-speed least squares, expansion",
            "weighted; docs/noise.md",
            "the noise",
            least_squares.solve_expanded,
        ),
        Method(
            "smoothed",
            "smoothed least squares",
            "Reinsch 1967; Craven, Wahba 1979; Wahba 1983",
            "the noise",
            least_squares.solve_smoothed,
        ),
        Method(
            "tikhonov",
            "per-speed least squares, Tikhonov",
            "Tiwari, Lees, Friswell 2002; Golub, Heath, Wahba 1979",
            "nothing",
            least_squares.solve_tikhonov,
        ),
        Method(
            "total_least_squares",
            "weighted total least squares",
            "De Troyer et al. 2012",
            "the noise",
            least_squares.solve_total,
        ),
        Method(
            "multi_frequency",
            "impulse or several frequencies",
            "Qiu, Tieu 1997; Tiwari, Chakravarthy 2006",
            "a shaker or hammer",
            multi_frequency.identify_by_frequencies,
            takes_planes=True,
        ),
        Method(
            "kalman",
            "stationary Kalman smoother, least squares",
            "after Kang et al. 2020",
            "the noise, a guess",
            least_squares.identify_by_filter,
        ),
        Method(
            "kriging",
            "Kriging and differential evolution",
            "Han, Guo, Gao 2013",
            "bounds, modelled responses",
            kriging.identify_by_kriging,
        ),
        Method(
            "critical_speeds",
            "network of critical speeds",
            "Pavlenko et al. 2018",
            "bounds, modelled critical speeds",
            critical_speeds.identify_by_critical_speeds,
        ),
        Method(
            "spline",
            "output error, spline",
            "SciPy least squares",
            "the noise, a guess",
            spline.identify_by_spline,
            takes_planes=True,
        ),
        Method(
            "paper",
            "FEM-NN, the paper's residual",
            "the paper, eq. 6, unscaled, tuned Adam",
            "a guess",
            fit_by(lambda options: options.settings.paper),
            takes_conditions=True,
        ),
        Method(
            "paper_scaling",
            "the paper's residual, scaled",
            "docs/method.md",
            "a guess",
            fit_by(lambda options: improve_paper(options, scaling=True)),
            takes_conditions=True,
        ),
        Method(
            "paper_logarithm",
            "the paper's residual, logarithmic output",
            "docs/method.md",
            "a guess",
            fit_by(lambda options: improve_paper(options, logarithm=True)),
            takes_conditions=True,
        ),
        Method(
            "paper_second_order",
            "the paper's residual, Levenberg-Marquardt",
            "docs/method.md",
            "a guess",
            fit_by(lambda options: improve_paper(options, second_order=True)),
            takes_conditions=True,
        ),
        Method(
            "residual",
            "FEM-NN, improved residual",
            "docs/method.md",
            "a guess",
            fit_by(lambda options: options.settings.residual),
            takes_conditions=True,
        ),
        Method(
            "preconditioned",
            "FEM-NN, preconditioned residual",
            "docs/method.md",
            "a guess",
            fit_by(lambda options: options.settings.preconditioned),
            takes_conditions=True,
        ),
        Method(
            "response",
            "FEM-RF, output error",
            "docs/noise.md",
            "the noise, a guess",
            fit_by(lambda options: options.settings.response),
            takes_planes=True,
            takes_conditions=True,
        ),
        Method(
            "trained",
            "FEM-NN, output error, trained hidden layers",
            "docs/noise.md",
            "the noise, a guess",
            fit_trained,
            takes_planes=True,
            takes_conditions=True,
        ),
        Method(
            "law",
            "bearing laws, output error",
            "docs/laws.md",
            "the noise, the laws",
            fit_laws,
            takes_planes=True,
            takes_conditions=True,
        ),
    )
}
