"""Published numbers that the fleet's page compares with, each with its source. None of them is ours."""

import numpy as np

__all__ = [
    "ACCEL_EDGES",
    "CONSUMPTION",
    "CYCLE_LIMITS",
    "CYCLE_SPEEDS_KMH",
    "GRADE_EDGES",
    "PAPER_FLEET_PE",
    "PAPER_MODEL_PE",
    "ZTBUS",
    "ZTBUS_ACCEL",
    "ZTBUS_GRADE",
]

# Paper 1, tables 1 and 2: percent error of the tabular values
PAPER_MODEL_PE = {"A": -15.5, "B": -5.18, "C": -7.25, "D": 34.1}
PAPER_FLEET_PE = -40.4

# ZTBus: 24 missions of two 19 m trolleybuses in Zurich; F. Widmer, A. Ritter, C. H. Onder, Scientific Data 10:687
# (2023).
# Shares by bin as benchmarks/fleet_references.py prints them: slopes by distance, accelerations by time in motion.
GRADE_EDGES = np.linspace(-10.0, 10.0, 21)  # %
ACCEL_EDGES = np.linspace(-2.0, 2.0, 17)  # m/s²
ZTBUS = "measured: ZTBus\n(Widmer et al. 2023)"
ZTBUS_GRADE = (0.0016, 0.0046, 0.0052, 0.0148, 0.0198, 0.0131, 0.0091, 0.0242, 0.0898, 0.3261, 0.3021, 0.0863, 0.0321,
               0.0160, 0.0059, 0.0205, 0.0168, 0.0104, 0.0013, 0.0003)  # fmt: skip
ZTBUS_ACCEL = (0.0003, 0.0011, 0.0074, 0.0293, 0.0607, 0.0822, 0.1070, 0.2159, 0.1819, 0.1028, 0.0983, 0.1133, 0.0, 0.0,
               0.0, 0.0)  # fmt: skip

# DieselNet, Emission Test Cycles: largest deceleration and acceleration [m/s²] of chassis cycles for heavy trucks,
# given there in mph/s (HHDDT transient −2.8 and 3.0, cruise −2.5 and 2.3, UDDS −4.6 and 4.4)
CYCLE_LIMITS = {"HHDDT transient": (-1.25, 1.34), "HHDDT cruise": (-1.12, 1.03), "UDDS (heavy)": (-2.06, 1.97)}
# DieselNet: mean speeds with stops [km/h]; of the World Harmonized Vehicle Cycle its three parts
CYCLE_SPEEDS_KMH = {
    "Manhattan bus": 11.0,
    "WHVC urban": 21.3,
    "Braunschweig": 22.9,
    "HHDDT transient": 24.8,
    "WHVC rural": 43.6,
    "HHDDT cruise": 64.2,
    "WHVC motorway": 76.7,
}

# Consumption [kWh/km] as published, by the kind of vehicle: (what, value, source)
CONSUMPTION: dict[str, tuple[tuple[str, float, str], ...]] = {
    "tractor": (
        ("fleet of customers, mean", 0.90, "MAN Truck & Bus, press release, September 2025 (eTGX, eTGS)"),
        ("40 t, 80 km/h", 1.10, "Volvo Trucks, Green Truck Route, January 2022 (FH Electric)"),
        ("32 t, winter", 1.17, "MAN Truck & Bus, Arctic Circle to Munich, 2025 (eTGX)"),
        ("37 t, 170 kWh for 100 km", 1.70, "DAF CF Electric, Transport Engineer, February 2019"),
    ),
    "truck": (("26 t, 185 kWh for up to 200 km", 0.93, "MAN TGM 6x2, Transport Engineer, February 2019"),),
    "bus": (
        ("12 m, light, mean", 0.78, "Aalto University, Energies 11(12):3267 (2018)"),
        ("12 m, mean of 79", 1.15, "ViriCiti, 2020 (Netherlands)"),
        ("the same, cold", 1.31, "ViriCiti, 2020: 14 % more from −10 to 14 °C"),
    ),
    "articulated": (
        ("19 m, least of 24 missions", 1.20, "ZTBus, Widmer et al., Scientific Data 10:687 (2023)"),
        ("18 m, mean of 27", 1.63, "ViriCiti, 2020 (Netherlands)"),
        ("the same, cold", 1.97, "ViriCiti, 2020: 21 % more from −10 to 14 °C"),
        ("19 m, most of 24 missions", 2.13, "ZTBus, Widmer et al., Scientific Data 10:687 (2023)"),
    ),
}
