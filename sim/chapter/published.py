"""Values printed in the chapter: Tables 2.1 to 2.5 and figures from its text. Errors are in percent of the range."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PublishedModel:
    """One column of Tables 2.4 and 2.5. ``max_um`` is the largest modelling error given in the text."""

    parameters: int
    identification_s: float
    modelling_mae_pct: float
    modelling_rmse_pct: float
    generalisation_mae_pct: float
    generalisation_rmse_pct: float
    feedforward_mae_pct: float
    feedforward_rmse_pct: float
    hybrid_mae_pct: float
    hybrid_rmse_pct: float
    max_um: float


#: Tables 2.4 and 2.5, and the largest errors of sections 2.4.1 to 2.4.3.
MODELS = {
    "bouc_wen": PublishedModel(7, 614.89, 1.276, 1.560, 1.253, 1.530, 1.199, 1.660, 0.024, 0.048, 4.70),
    "mpi": PublishedModel(20, 759.91, 1.358, 1.692, 1.318, 1.621, 1.080, 1.813, 0.023, 0.052, 6.35),
    "lssvm": PublishedModel(2, 2.56, 0.364, 0.470, 0.621, 0.858, 0.416, 0.537, 0.015, 0.038, 1.27),
}

#: Table 2.1: search space and identified value, in the table's units.
TABLE_2_1 = {
    "m": ("kg", (0.0, 1.0), 0.2789),
    "b": ("N s/m", (1e2, 1e6), 8.9055e5),
    "k": ("N/m", (1e3, 1e9), 3.5244e8),
    "d": ("m/V", (0.0, 0.1), 1.1351e-5),
    "alpha": ("", (0.0, 1.0), 0.4754),
    "beta": ("1/V", (0.0, 1.0), 0.8718),
    "gamma": ("1/V", (0.0, 1.0), 0.9925),
}

#: Table 2.2: r_i, w_hi, then d_j, w_sj.
TABLE_2_2 = (
    (0.0, 0.6036, 1.2072, 1.8108, 2.4145, 3.0181, 3.6217, 4.2253, 4.8289, 5.4325, 6.0362, 6.6398, 7.2434),
    (0.0677, 0.0228, 6.5979e-6, 0.0196, 0.0037, 4.0252e-6, 1.0681e-6, 6.7711e-8, 6.1372e-8, 3.8439e-8, 2.9690e-8,
     8.4374e-9, 0.0),
    (0.0, 0.1276, 0.2552, 0.3827, 0.5103, 0.6379, 0.7655),
    (99.9999, -1.0010e-5, -3.3798e-5, -1.5611e-5, 0.0, -2.6054e-4, -6.8291e-5),
)  # fmt: skip

#: Table 2.3: r*_i, w*_hi, then d*_j, w*_sj.
TABLE_2_3 = (
    (0.0, 0.0408, 0.0954, 0.1500, 0.2164, 0.2850, 0.3537, 0.4223, 0.4909, 0.5596, 0.6282, 0.6969, 0.7655),
    (14.7797, -3.7195, -8.0705e-4, -1.9672, -0.2980, -3.1129e-4, -8.2597e-5, -5.2362e-6, -4.7460e-6, -2.9725e-6,
     -2.2959e-6, -6.5247e-7, 0.0),
    (0.0, 12.7581, 25.5163, 38.2744, 51.0326, 63.7907, 76.5488),
    (0.0100, 1.0010e-9, 1.3798e-9, 1.5611e-9, 0.0, 2.6054e-8, 6.8292e-9),
)  # fmt: skip

#: Forward and inverse LSSVM, sections 2.4.3 and 2.5.3: (gamma, sigma).
FORWARD_HYPER = (741.57, 7.39)
INVERSE_HYPER = (741.82, 7.69)
#: Section 2.5.3.
GAINS = {"K_p": 0.0864, "K_i": 31.1040, "K_d": 0.0}
#: Fig. 2.2: displacement of the other axis, percent.
CROSS_TALK_PCT = 1.17
