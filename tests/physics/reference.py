"""The chain once more, row by row in plain Python and NumPy, sharing no code with the package.

A row is a dict of numbers, a vehicle a dict of coefficients, effects a dict of parameters by id. Written from the
papers (paper 1, equations 3-5; paper 2, equations 2-12) and from the equations that each effect states.
"""

import math

import numpy as np

G = 9.80665
RHO0 = 1.225


def energy_wh(rows: list[dict], car: dict, effects: dict[str, dict]) -> list[float]:
    """Battery energy of each row [Wh]."""
    rows = [dict(r) for r in rows]
    trips: dict[int, list[dict]] = {}
    for r in rows:
        trips.setdefault(r["trip"], []).append(r)
    for trip in trips.values():
        prepare(trip, effects)
    for r in rows:
        r["power_w"] = battery_power_w(r, car, effects)
    for trip in trips.values():
        instrument(trip, effects)
    return [r["power_w"] * r["duration_s"] / 3600.0 for r in rows]


def prepare(trip: list[dict], effects: dict) -> None:
    """What needs the rows before: slope that came late, distance since the start, time since braking."""
    if "grade_noise" in effects:
        with_less_noise(trip, effects["grade_noise"]["sd_rad"])
    if "grade_lag" in effects:
        later = [later_slope(trip, k, effects["grade_lag"]["lag_s"]) for k in range(len(trip))]
        for r, slope in zip(trip, later, strict=True):
            r["grade_rad"] = slope
    gone, released = 0.0, None
    for r in trip:
        r["gone_m"] = gone + r["distance_m"] / 2
        gone += r["distance_m"]
        if r["brake_pressure_pa"] > 2e4:
            released = r["time_s"] + r["duration_s"]
            r["since_s"] = None
        else:
            r["since_s"] = None if released is None else r["time_s"] + r["duration_s"] / 2 - released


def with_less_noise(trip: list[dict], sd_rad: float) -> None:
    """Slopes less what is expected of their error, given what a line on the neighbours' mean leaves of them."""
    moving = [k for k, r in enumerate(trip) if r["distance_m"] > 0]
    if len(moving) < 3:
        return
    x = np.array([r["grade_rad"] for r in trip])
    near = np.convolve(np.r_[x[1], x, x[-2]], [0.5, 0.0, 0.5], mode="valid")
    own, others = x - np.mean(x[moving]), near - np.mean(near[moving])
    differ = np.std(near[moving]) > 1e-5 * np.sqrt(np.mean(x[moving] ** 2))
    told = np.linalg.lstsq(others[moving, None], own[moving], rcond=None)[0][0] if differ else 0.0
    rest = own - told * others
    if (left := np.sum(rest[moving] ** 2)) > 1e-10 * np.sum(x[moving] ** 2):
        share = min(sd_rad**2 * (len(moving) - 2) / left, 1.0)
        for k in moving:
            trip[k]["grade_rad"] -= share * rest[k]


def later_slope(trip: list[dict], k: int, lag_s: float) -> float:
    """What row k climbs over its way, both of where its ends are `lag_s` later."""
    a, b = (trip[k]["time_s"] + lag_s, trip[k]["time_s"] + trip[k]["duration_s"] + lag_s)
    (way_a, height_a), (way_b, height_b) = place(trip, a), place(trip, b)
    if way_b - way_a > 0.05:
        return (height_b - height_a) / (way_b - way_a)
    begin, end = trip[0]["time_s"], trip[-1]["time_s"] + trip[-1]["duration_s"]
    middle = (min(max(a, begin), end) + min(max(b, begin), end)) / 2
    return trip[row_at(trip, middle)]["grade_rad"]


def row_at(trip: list[dict], t: float) -> int:
    """The last row that has begun."""
    return max([k for k, r in enumerate(trip) if r["time_s"] <= t], default=0)


def place(trip: list[dict], t: float) -> tuple[float, float]:
    """Way and height at a time: rows of constant acceleration, heights by Hermite's four polynomials in distance."""
    k = row_at(trip, t)
    r, d = trip[k], trip[k]["distance_m"]
    share = min(max((t - r["time_s"]) / r["duration_s"], 0.0), 1.0)
    u, v = r["speed_start_mps"], r["speed_end_mps"]
    x = share * (2 * u + (v - u) * share) / (u + v) if u + v > 0 else share

    def at_node(i: int, j: int) -> float:
        """The slope between two rows, the shorter one counting for more."""
        i, j = max(i, 0), min(j, len(trip) - 1)
        d_i, d_j = (max(trip[n]["distance_m"], 1e-9) for n in (i, j))
        return (trip[i]["grade_rad"] * d_j + trip[j]["grade_rad"] * d_i) / (d_i + d_j)

    climb = r["grade_rad"] * (3 * x**2 - 2 * x**3)
    climb += at_node(k - 1, k) * (x**3 - 2 * x**2 + x) + at_node(k, k + 1) * (x**3 - x**2)
    way = sum(q["distance_m"] for q in trip[:k]) + d * x
    return way, sum(q["distance_m"] * q["grade_rad"] for q in trip[:k]) + d * climb


def battery_power_w(r: dict, car: dict, effects: dict) -> float:
    """One row, from the road to the battery."""
    dt, d = r["duration_s"], r["distance_m"]
    v0, v1 = r["speed_start_mps"], r["speed_end_mps"]
    m, theta = r["mass_kg"], r["grade_rad"]
    if p := effects.get("mass_scale"):
        m = m * (1 + p["scale"])
    if p := effects.get("grade_scale"):
        theta = theta + p["scale"] * theta
    if p := effects.get("grade_bias"):
        theta = theta + p["bias_rad"]
    if p := effects.get("speed_scale"):
        d, v0, v1 = d * (1 + p["scale"]), v0 * (1 + p["scale"]), v1 * (1 + p["scale"])
    v, a, square = d / dt, (v1 - v0) / dt, (v0**2 + v1**2) / 2

    # paper 1, equations 3 and 4
    force = car["rotating"] * m * a + m * G * math.sin(theta) + m * G * car["c_rr"] * math.cos(theta)
    force += 0.5 * RHO0 * car["cda_m2"] * square
    if p := effects.get("headwind"):
        wind = p["scale"] * r["wind_speed_mps"] * math.cos(r["wind_from_rad"] - r["heading_rad"])
        for end in (v0, v1):  # the mean of both, as without wind
            air = end + wind
            force += 0.25 * RHO0 * car["cda_m2"] * (math.copysign(air**2, air) - end**2)
    if p := effects.get("rolling_temperature"):
        force += m * G * math.cos(theta) * p["per_k"] * (r["ambient_temp_c"] - 20)
    if p := effects.get("tyre_warmup"):
        force += m * G * math.cos(theta) * car["c_rr"] * p["excess"] * math.exp(-r["gone_m"] / p["distance_m"])
    if p := effects.get("road_surface"):
        force += m * G * math.cos(theta) * car["c_rr"] * p["excess"][int(r["road_surface"])]
    if p := effects.get("rolling_linear"):
        force += p["n_per_mps"] * v
    if p := effects.get("cornering"):
        force += p["coefficient"] * m * (square * r["curvature_1pm"]) ** 2
    if (p := effects.get("brake_drag")) and r["since_s"] is not None and v > 0.1:
        force += p["force_n"] * math.exp(-r["since_s"] / p["tau_s"])

    # paper 1, equation 5
    force = force / car["efficiency"] if force > 0 else force * car["efficiency"]
    ratio = car["gear_ratios"][int(r["gear"]) - 1] * car["final_drive"] / car["wheel_radius_m"]
    if p := effects.get("driveline_drag"):
        force += p["torque_nm"][int(r["gear"])] * ratio
    if p := effects.get("gear_efficiency"):
        force += p["delta"][int(r["gear"])] * abs(force)
    torque, omega, power = force / ratio, v * ratio, force * v

    # paper 2, equations 5, 6, 10 and 11
    if not car["covers_machine"]:
        power = power / car["motoring"] if power > 0 else power * car["regenerating"]
    if p := effects.get("copper_loss"):
        power += p["w_per_nm2"] * torque**2
    if p := effects.get("iron_loss"):
        power += p["w_per_radps"] * abs(omega) + p["w_per_radps2"] * omega**2
    if p := effects.get("part_load"):
        power += p["standby_w"] * abs(power) / (p["half_w"] + abs(power)) + p["per_w"] * power**2
    if p := effects.get("efficiency_scale"):
        power += p["scale"] * abs(power)
    power += car["auxiliary_w"]
    if p := effects.get("auxiliary_power"):
        power += p["power_w"]
    if p := effects.get("hvac_power"):
        t = r["ambient_temp_c"]
        power += p["below_w_per_k"] * max(p["heat_c"] - t, 0) + p["above_w_per_k"] * max(t - p["cool_c"], 0)
    if p := effects.get("passenger_heat"):
        t, hvac = r["ambient_temp_c"], effects.get("hvac_power", {"heat_c": 18.0, "cool_c": 22.0})
        cooled = 1 / (1 + math.exp(hvac["cool_c"] - t))
        heated = 1 / (1 + math.exp(t - hvac["heat_c"]))
        power += p["w_per_passenger"] * r["passengers"] * (cooled - heated)
    if p := effects.get("cabin_warmup"):
        power += p["power_w"] * math.exp(-(r["time_s"] + dt / 2) / p["tau_s"])
    if (p := effects.get("regen_efficiency")) and power < 0:
        power -= p["share"] * power
    if (p := effects.get("friction_blending")) and r["brake_pressure_pa"] > p["above_pa"] and power < 0:
        power -= p["share"] * power
    if p := effects.get("battery_resistance"):
        power += p["resistance_ohm"] * (power / r["voltage_v"]) ** 2
    if p := effects.get("regen_limit"):
        power += p["share"] * (max(power, -p["power_w"]) - power)
    return power


def instrument(trip: list[dict], effects: dict) -> None:
    """What the power sensor makes of it: delay, filter, gain."""
    column = [r["power_w"] for r in trip]
    if p := effects.get("time_skew"):
        column = [late(column, k, p["skew_s"] / r["duration_s"]) for k, r in enumerate(trip)]
    if p := effects.get("sampling_filter"):
        held = lambda k: column[min(max(k, 0), len(column) - 1)]  # noqa: E731
        bend = lambda k, j: held(k - j) - 2 * held(k) + held(k + j)  # noqa: E731
        column = [x + p["tap_1"] * bend(k, 1) + p["tap_2"] * bend(k, 2) for k, x in enumerate(column)]
        for k in range(1, len(column)):
            keep = math.exp(-trip[k]["duration_s"] / p["tau_s"])
            column[k] = keep * column[k - 1] + (1 - keep) * column[k]
    if p := effects.get("power_gain"):
        column = [x * (1 + p["gain"]) + p["offset_w"] for x in column]
    for r, x in zip(trip, column, strict=True):
        r["power_w"] = x


def late(column: list[float], k: int, rows: float) -> float:
    """The column `rows` rows earlier than row k, through the cubic of the four rows around; held past the ends."""
    nodes = [math.floor(k - rows) + j for j in (-1, 0, 1, 2)]
    if float(k - rows).is_integer():
        nodes = [math.floor(k - rows)]
    total = 0.0
    for i in nodes:
        weight = 1.0
        for j in nodes:
            if j != i:
                weight *= (k - rows - j) / (i - j)
        total += weight * column[min(max(i, 0), len(column) - 1)]
    return total
