"""The papers' equations by hand, and identities that hold whatever the numbers."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import physics_rows as made
import pytest

from hdev_jax.physics import Driveline, EfficiencyMap, Machine, Vehicle
from hdev_jax.physics.battery import BatteryResistance, FrictionBlending, RegenCutoff, RegenLimit, TractionLimit
from hdev_jax.physics.machine import switch
from hdev_jax.physics.road import Aero, AirDensity, ConstantHeadwind, Grade, Headwind, Inertia, Rolling
from hdev_jax.segments import ACCEL_SD, GRADE_SD, Segments
from hdev_jax.units import GRAVITY_MPS2

M, G, RHO = 24e3, 9.80665, 1.225


def joules(car: Vehicle, log: Segments) -> float:
    return float(jnp.sum(car.energy(log))) * 3600.0


def same(actual: Any, expected: Any) -> None:
    np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-12)


# --- equations, by hand --------------------------------------------------------------------------------------------


def row_by_hand(up: bool) -> tuple[Segments, float, float]:
    """One row with its force [N] and energy at the wheels [J], from equations 3 and 4 of paper 1."""
    theta = 0.02 if up else -0.05
    row = made.one_row(
        duration_s=8.0, distance_m=100.0, speed_start_mps=12.0, speed_end_mps=13.0, grade_rad=theta, mass_kg=M
    )
    inertia, slope = M * (13.0 - 12.0) / 8.0, M * G * np.sin(theta)
    rolling, drag = M * G * 0.006 * np.cos(theta), 0.5 * RHO * 5.6 * (12.0**2 + 13.0**2) / 2
    force = inertia + slope + rolling + drag
    return row, force, force * 100.0


@pytest.mark.parametrize("up", [True, False])
def test_paper_1_equations_3_to_5(up: bool) -> None:
    row, force, e_w = row_by_hand(up)
    assert (e_w > 0) == up
    car = made.baseline(rotating=1.0, auxiliary_w=0.0)
    same(car.force(row), [force])
    same(car.energy(row), [e_w / 3600 / 0.91 if up else e_w / 3600 * 0.91])
    same(car.power(row), car.energy(row) * 3600 / 8.0)
    same(car.predict(row, "energy_wh"), car.energy(row))
    same(car.predict(row, "battery_power_kw"), car.power(row) / 1000)
    same(car.predict(row, "traction_force_n"), [force])


def test_drag_without_wind_is_equation_4() -> None:
    log = made.drives(*made.LENGTHS)
    drag = 0.5 * RHO * 5.6 * (log.speed_start_mps**2 + log.speed_end_mps**2) / 2
    same(made.single(Aero(made.arr(5.6))).force(log), drag)
    calm = log.with_channels(wind_speed_mps=np.zeros(len(log)))
    same(made.single(Aero(made.arr(5.6))).plus(Headwind(made.arr(1.0))).force(calm), drag)


@pytest.mark.parametrize("wind", [4.0, -4.0])
def test_paper_2_equation_2(wind: float) -> None:
    """F = m·g·C_r·cosα + m·g·sinα + ½ρC_dA(v + v_w)² + λ·m·a at a steady speed, where v_i = v_f = v."""
    row = made.one_row(grade_rad=0.01, mass_kg=M)
    car = made.baseline(rotating=1.05).plus(ConstantHeadwind(made.arr(wind)))
    drag = 0.5 * RHO * 5.6 * (10.0 + wind) ** 2
    same(car.force(row), [M * G * 0.006 * np.cos(0.01) + M * G * np.sin(0.01) + drag])
    faster = made.one_row(speed_start_mps=9.0, speed_end_mps=11.0)
    same(made.single(Inertia(made.arr(1.05))).force(faster), [1.05 * M * 2.0 / 10.0])
    # while speed changes the air's is squared at both ends, as equation 4 of paper 1 has it without wind
    both = 0.25 * RHO * 5.6 * ((9.0 + wind) ** 2 + (11.0 + wind) ** 2)
    same(made.single(Aero(made.arr(5.6))).plus(ConstantHeadwind(made.arr(wind))).force(faster), [both])


@pytest.mark.parametrize("up", [True, False])
def test_paper_2_equations_3_4_and_9(up: bool) -> None:
    """Power is F·v; the motor's torque is F·r/(o·η) driving and F·η·r/o braking."""
    row, force, _ = row_by_hand(up)
    car = made.baseline(rotating=1.0, covers_machine=False, auxiliary_w=0.0)
    row = row.with_channels(gear=np.array([2.0]))
    ratio = 5.27 * 4.5
    torque = force * 0.5 / (ratio * 0.91) if up else force * 0.91 * 0.5 / ratio
    same(car.torque(row), [torque])
    same(car.predict(row, "motor_torque_nm"), [torque])
    # equations 5, 6, 8 and 10: at the battery
    machine = 1 / 0.93 if up else 0.88
    same(car.power(row), [torque * ratio / 0.5 * (100.0 / 8.0) * machine])


@pytest.mark.parametrize("torque", [-300.0, 0.0, 300.0])
def test_paper_2_equations_6_10_and_11_from_the_shaft(torque: float) -> None:
    row = made.one_row(motor_torque_nm=torque, motor_speed_radps=150.0)
    expected = torque * 150.0 / 0.93 if torque >= 0 else torque * 150.0 * 0.88
    same(made.baseline("shaft", auxiliary_w=0.0).power(row), [expected])


@pytest.mark.parametrize("force", [-5000.0, 0.0, 5000.0])
def test_entry_at_the_wheel(force: float) -> None:
    row = made.one_row(traction_force_n=force)
    expected = force * 10.0 / 0.93 if force >= 0 else force * 10.0 * 0.88
    same(made.baseline("wheel", auxiliary_w=800.0).power(row), [expected + 800.0])


def test_paper_2_equations_7_and_8() -> None:
    """Friction blending of share s is η_rg = 1 − s."""
    braking = made.one_row(traction_force_n=-5000.0, brake_pressure_pa=1e6)
    released = made.one_row(traction_force_n=-5000.0, brake_pressure_pa=0.0)
    car = made.baseline("wheel", auxiliary_w=0.0)
    blended = car.plus(FrictionBlending(share=made.arr(0.3), above_pa=made.arr(2e4)))
    same(blended.power(braking), 0.7 * car.power(braking))
    same(blended.power(released), car.power(released))


@pytest.mark.parametrize("effect_id", ["aero", "headwind", "constant_headwind", "crosswind", "drafting", "wet_road"])
def test_what_goes_with_the_air_goes_with_its_density(effect_id: str) -> None:
    """½ρC_dA·v² with the ρ of the log, in every part that the declared drag is a factor of, once."""
    log = made.drives(*made.LENGTHS)
    dense = log.with_channels(air_density_kgpm3=np.linspace(0.9, 1.4, len(log)))
    car = made.single(Aero(5.6)) if effect_id == "aero" else made.single(Aero(5.6)).plus(made.typical(effect_id))
    factor = np.linspace(0.9, 1.4, len(log)) / RHO
    same(car.force(dense), np.asarray(car.force(log)) * factor)


def test_the_logs_density_leaves_nothing_to_the_effect_of_temperature() -> None:
    """Where density is logged the declared drag is that of the effect at 1 on a log of that day's temperature."""
    log = made.drives(*made.LENGTHS)
    pressure = 101325.0 * (1 - 2.25577e-5 * log.channels["altitude_m"]) ** 5.25588
    density = pressure / (287.05 * (log.channels["ambient_temp_c"] + 273.15))
    told = made.single(Aero(5.6)).plus(AirDensity(1.0)).force(log)
    same(made.single(Aero(5.6)).force(log.with_channels(air_density_kgpm3=density)), told)


@pytest.mark.parametrize("force", [-5000.0, 5000.0])
def test_braking_with_an_efficiency_of_its_own(force: float) -> None:
    row = made.one_row(mass_kg=1000.0, speed_end_mps=10.0 + force / 100.0 * 0.1, speed_start_mps=10.0)
    asked = float(made.single(Inertia(1.0)).force(row)[0])
    line = Driveline(0.9, regenerating_efficiency=0.7)
    car = Vehicle([Inertia(1.0)], mass_kg=1.0, driveline=line)
    same(car.power(row), [asked * 10.0 / 0.9 if force > 0 else asked * 10.0 * 0.7])
    same(Vehicle([Inertia(1.0)], mass_kg=1.0, driveline=Driveline(0.9)).power(row),
         [asked * 10.0 / 0.9 if force > 0 else asked * 10.0 * 0.9])  # fmt: skip


def test_the_log_has_the_last_word_on_voltage() -> None:
    row = made.one_row(traction_force_n=5000.0)
    car = Vehicle([BatteryResistance(0.1)], mass_kg=1.0, entry="wheel", nominal_voltage_v=500.0)
    same(car.power(row), [5e4 + 0.1 * 100.0**2])
    same(car.power(row.with_channels(voltage_v=np.array([250.0]))), [5e4 + 0.1 * 200.0**2])
    with pytest.raises(ValueError, match="nominal_voltage_v"):
        Vehicle([BatteryResistance(0.1)], mass_kg=1.0, entry="wheel").power(row)


def test_torque_without_a_motor_speed_turns_with_the_wheels() -> None:
    line = Driveline(1.0, [9.0, 4.0], final_drive=4.0, wheel_radius_m=0.5)
    car = Vehicle([], mass_kg=1.0, driveline=line, machine=Machine(0.9, 0.8), entry="shaft")
    row = made.one_row(motor_torque_nm=100.0, gear=2.0)
    same(car.power(row), [100.0 * 10.0 * 4.0 * 4.0 / 0.5 / 0.9])
    same(car.power(row.with_channels(motor_speed_radps=np.array([150.0]))), [100.0 * 150.0 / 0.9])


def test_the_log_has_the_last_word_on_mass() -> None:
    car = made.single(Rolling(made.arr(0.006)))
    same(car.force(made.one_row()), [24e3 * G * 0.006])
    same(car.force(made.one_row(mass_kg=1000.0)), [1000.0 * G * 0.006])


# --- identities ----------------------------------------------------------------------------------------------------


def test_accelerating_costs_the_kinetic_energy() -> None:
    v1, v2 = 5.0, 17.0
    ends = np.linspace(v1, v2, 19)
    duration = np.linspace(0.5, 2.0, 18)
    n = np.zeros(18, int)
    distance = 0.5 * (ends[1:] + ends[:-1]) * duration
    log = Segments(n, n, np.cumsum(duration) - duration, duration, distance, ends[:-1], ends[1:], {})
    same(joules(made.single(Inertia(made.arr(1.0))), log), 0.5 * M * (v2**2 - v1**2))


def test_up_and_down_a_hill_sums_to_zero() -> None:
    rng = np.random.default_rng(1)
    slope, distance = rng.normal(0, 0.04, 9), rng.uniform(50, 200, 9)
    n, there_and_back = np.zeros(18, int), np.r_[distance, distance[::-1]]
    grade = {"grade_rad": np.r_[slope, -slope[::-1]]}
    log = Segments(
        n, n, 10.0 * np.arange(18), np.full(18, 10.0), there_and_back, np.full(18, 9.0), np.full(18, 9.0), grade
    )
    climbed = M * G * np.sum(np.sin(slope) * distance)
    energy = 3600.0 * np.asarray(made.single(Grade()).energy(log))
    np.testing.assert_allclose(np.sum(energy[:9]), climbed)
    assert abs(np.sum(energy)) < 1e-9 * abs(climbed)


def test_doubling_the_mass_doubles_rolling() -> None:
    log = made.drives(*made.LENGTHS)
    heavy = log.with_channels(mass_kg=2 * log.channels["mass_kg"])
    one, two = made.baseline().breakdown(log), made.baseline().breakdown(heavy)
    for effect, factor in {"rolling": 2, "inertia": 2, "grade": 2, "aero": 1, "auxiliary": 1}.items():
        np.testing.assert_array_equal(two[effect], factor * one[effect])


def test_tailwind_at_the_speed_of_the_vehicle_gives_no_drag() -> None:
    row = made.one_row(wind_speed_mps=10.0, wind_from_rad=0.3 + np.pi, heading_rad=0.3)
    car = made.single(Aero(made.arr(5.6))).plus(Headwind(made.arr(1.0)))
    assert abs(float(car.force(row)[0])) < 1e-9
    ahead = row.with_channels(wind_from_rad=np.array([0.3]))
    same(car.force(ahead), [4 * 0.5 * RHO * 5.6 * 10.0**2])
    # a wind from behind that is faster still pushes
    assert float(car.force(row.with_channels(wind_speed_mps=np.array([15.0])))[0]) < 0
    same(made.single(Aero(made.arr(5.6))).plus(ConstantHeadwind(made.arr(-10.0))).force(row), [0.0])


def test_standstill_costs_the_auxiliary_alone() -> None:
    row = made.one_row(distance_m=0.0, speed_start_mps=0.0, speed_end_mps=0.0, grade_rad=0.03)
    same(made.baseline(auxiliary_w=720.0).energy(row), [720.0 * 10.0 / 3600.0])


# --- switches: value and slope, from both sides --------------------------------------------------------------------


def test_efficiency_switch_at_zero() -> None:
    """0 at e_w = 0, where the slope is the braking one, "otherwise" in equation 5; forward and reverse."""
    f = lambda x: switch(x, 0.9, 0.8)  # noqa: E731
    for gradient in (jax.grad(f), jax.jacfwd(f)):
        same(gradient(0.0), 0.8)
        same(gradient(-1e-300), 0.8)
        same(gradient(1e-300), 1 / 0.9)
    assert f(0.0) == 0.0
    step = 1e-6
    same((f(step) - f(0.0)) / step, 1 / 0.9)
    same((f(0.0) - f(-step)) / step, 0.8)
    in_efficiency = jax.grad(lambda e: switch(0.0, e, e))
    assert in_efficiency(0.9) == 0.0


def test_energy_at_the_switch() -> None:
    """A row whose forces are exactly zero: no energy, finite slopes, braking side in c_rr."""
    row = made.one_row(grade_rad=0.0)
    car = lambda c: made.baseline(c_rr=c, cda_m2=0.0, auxiliary_w=0.0)  # noqa: E731
    energy = lambda c: car(c).energy(row)[0]  # noqa: E731
    told = jax.jit(lambda c: (energy(c), jax.grad(energy)(c), jax.jacfwd(energy)(c)))
    assert told(0.0)[0] == 0.0
    per_joule = M * G * 100.0 / 3600
    for gradient in (1, 2):
        same(told(0.0)[gradient], per_joule * 0.91)
        same(told(-1e-9)[gradient], per_joule * 0.91)
        same(told(1e-9)[gradient], per_joule / 0.91)


@pytest.mark.parametrize(
    ("effect", "power", "slopes"), [(RegenLimit(3e4), -3e4, (-1.0, 0.0)), (TractionLimit(9e4), 9e4, (0.0, -1.0))]
)
def test_limits_from_both_sides(effect: Any, power: float, slopes: tuple[float, float]) -> None:
    """What the limit adds is 0 at the limit, and its slope in the power one of the two sides' or between."""

    def added(p: Any) -> Any:
        point = made.one_row()
        return effect.power(point, None, type("Point", (), {"power_w": p})())

    assert added(jnp.asarray(power)) == 0.0
    same(jax.grad(added)(jnp.asarray(power - 1.0)), slopes[0])
    same(jax.grad(added)(jnp.asarray(power + 1.0)), slopes[1])
    assert min(slopes) <= jax.grad(added)(jnp.asarray(power)) <= max(slopes)
    assert jax.jacfwd(added)(jnp.asarray(power)) == jax.grad(added)(jnp.asarray(power))


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_a_limit_of_regeneration_may_act_in_part(share: float) -> None:
    """Of 50 kW of braking 20 kW are beyond the limit: all of that is lost, or a share of it."""
    car = made.single(RegenLimit(3e4, share), entry="wheel")
    same(car.power(made.one_row(traction_force_n=-5000.0)), [-5e4 + share * 2e4])
    same(car.power(made.one_row(traction_force_n=-2000.0)), [-2e4])
    same(made.single(RegenLimit(3e4), entry="wheel").power(made.one_row(traction_force_n=-5000.0)), [-3e4])


def test_regen_cutoff_takes_all_below_and_nothing_above() -> None:
    car = made.baseline("wheel", auxiliary_w=0.0)
    slow = made.one_row(traction_force_n=-3000.0, distance_m=20.0)
    fast = made.one_row(traction_force_n=-3000.0, distance_m=60.0)
    cut = car.plus(RegenCutoff(made.arr(4.0)))
    assert abs(float(cut.power(slow)[0])) < 1e-3
    np.testing.assert_allclose(cut.power(fast), car.power(fast), rtol=1e-6)
    driving = made.one_row(traction_force_n=3000.0, distance_m=20.0)
    same(cut.power(driving), car.power(driving))
    assert jax.grad(lambda v: car.plus(RegenCutoff(v)).power(slow)[0])(jnp.asarray(0.0)) == 0.0


# --- the vehicle ---------------------------------------------------------------------------------------------------


def test_the_map_stands_in_for_the_number() -> None:
    """A constant map is the number; one of two levels acts by the row's own gear."""
    log = made.drives(*made.LENGTHS, without=("motor_speed_radps",))
    gears, axis = jnp.array([1.0, 2.0, 3.0, 4.0]), jnp.array([-1e4, 1e4])
    flat = EfficiencyMap(gears, axis, axis, jnp.full((4, 2, 2), 0.91))
    same(made.baseline(efficiency=flat).energy(log), made.baseline().energy(log))
    levels = jnp.array([0.8, 0.85, 0.9, 0.95])[:, None, None]
    by_gear = EfficiencyMap(gears, axis, axis, jnp.broadcast_to(levels, (4, 2, 2)))
    energy = np.asarray(made.baseline(efficiency=by_gear).energy(log))
    for k, efficiency in enumerate([0.8, 0.85, 0.9, 0.95], start=1):
        here = log.channels["gear"] == k
        same(energy[here], np.asarray(made.baseline(efficiency=efficiency).energy(log))[here])


def test_effects_are_kept_by_stage_whatever_the_order_given() -> None:
    ids = ["regen_limit", "power_gain", "headwind", "battery_resistance", "driveline_drag", "mass_scale"]
    effects = [made.typical(i) for i in ids]
    one = made.baseline().plus(*effects)
    two = made.baseline().plus(*reversed(effects))
    assert [e.id for e in one.effects] == [e.id for e in two.effects]
    assert one.effects[-1].id == "regen_limit"
    log = made.drives(*made.LENGTHS)
    np.testing.assert_array_equal(one.energy(log), two.energy(log))


def test_without_ratios_torque_is_that_of_a_wheel() -> None:
    row = made.one_row()
    car = Vehicle([Rolling(0.006)], mass_kg=M, driveline=Driveline(1.0, wheel_radius_m=0.5))
    same(car.torque(row), [M * G * 0.006 * 0.5])


def test_an_error_of_the_readings_counts_as_the_mean_of_what_they_may_be() -> None:
    """Energy and breakdown are those of both sides; where power changes its sign, the losses of an error stay."""
    log, car = made.drives(*made.LENGTHS), made.baseline()
    sd, zero = jnp.full(len(log), 0.004), jnp.zeros(len(log))
    force_sd = jnp.hypot(sd, 0.03 / GRAVITY_MPS2)
    told = log.with_channels(**{GRADE_SD: sd, ACCEL_SD: zero + 0.03})
    grade = jnp.asarray(log.channels["grade_rad"])
    sides = [car.energy(log.with_channels(grade_rad=grade + e)) for e in (force_sd, -force_sd)]
    np.testing.assert_allclose(car.energy(told), 0.5 * (sides[0] + sides[1]), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(sum(car.breakdown(told).values()), car.energy(told), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(car.force(told), car.force(log), rtol=1e-4, atol=1.0)
    assert jnp.sum(car.energy(log.with_channels(**{GRADE_SD: zero + 0.05}))) > jnp.sum(car.energy(log)) + 0.1
    exact = log.with_channels(**{GRADE_SD: zero})
    np.testing.assert_allclose(car.energy(exact), car.energy(log), rtol=1e-12, atol=1e-9)
