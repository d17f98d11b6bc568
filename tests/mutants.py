"""Deliberate faults: a test counts once it has been seen to fail.

    python tests/mutants.py [filter]

Each fault changes one line in a temporary copy of the tree and runs the tests that must then turn
red. `filter` is part of a file name or of a changed text. As many faults are tried at a time as
MUTANT_JOBS says, by default one for each core. The exit status is 1 if a fault survives, no longer
fits its file or breaks more than its tests.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
COPIED = ("road_envs", "estimators", "leaderboard", "configs", "tests", "pyproject.toml")
PAPER_SAYS = "equations::test_accelerations_match_the_papers_corrected_equations"
LEAN = "equations::test_in_a_manoeuvre_the_body_is_an_inverted_pendulum"
JACOBIAN = "equations::test_the_jacobian_matches_central_differences"
FORMULA = "rosenbrock::test_one_step_equals_the_published_formula"
VALVE = "suspension::test_the_second_accumulator_follows_its_ode_through_a_switch"
WHOLE = "drive::test_a_drive_in_chunks_equals_the_whole_drive_bitwise"
CUBIC = "surface::test_between_samples_the_height_is_the_catmull_rom_cubic"
PLACED = "data_logger::test_accelerometers_measure_the_rigid_body_at_the_papers_locations"
LANE = "fleet::test_every_lane_matches_its_vehicle_simulated_alone"
SEEN = "road_recon_env::test_observations_equal_the_data_logger_applied_to_the_drive"
SINGLE = "vector_env::test_environment_i_equals_the_single_one_with_seed_plus_i_in_every_mode"
REFUSED = "config::test_an_invalid_vehicle_value_is_named_in_one_sentence"
DUALS = "sensitivity::test_the_tangent_equals_the_derivative_by_dual_numbers"
TRANSPOSE = "sensitivity::test_the_adjoint_of_a_step_is_the_transpose_of_its_tangent"
TABLE = "force_curves::test_a_table_is_exact_if_breakpoints_are_grid_points"
THIRD = "ode23s::test_a_step_plus_its_error_estimate_has_order_three"
BOUND = "information_bound::test_the_bound_is_the_inverse_of_prior_and_measured_information"
ODD_SAYS = "vehicle_variation::test_accelerations_match_the_papers_equations_with_the_variation"
SHUT = "vehicle_variation::test_closing_a_valve_on_twisted_ground_causes_no_motion"
AIR = "suspension::test_an_airborne_tyre_has_no_load_and_contact_starts_without_a_jump"
SLOPES = "suspension::test_tyre_stiffness_damping_and_curvature_match_differences"
GRADED = "perturbed_vehicle::test_a_record_of_s3_equals_simulator_and_faulty_data_logger"
FELT = "perturbed_vehicle::test_enveloping_is_the_mean_of_the_cubic_over_the_contact_length"
MOUNTED = "sensor_faults::test_readings_follow_location_tilt_gain_and_offset"
CONTRACT = "record_contract::test_every_estimator_"
LAYOUT = (
    "accelerometer_layouts::"
    "test_sensors_measure_the_second_derivative_of_the_height_where_they_are_mounted"
)
LOST = "sensor_faults::test_dropouts_have_the_stated_rate_and_length"
WHITENED = (
    "map_smoother::"
    "test_whitened_increments_give_the_same_coefficients_and_the_map_has_its_transpose"
)
NOT_WORSE = (
    "explained::test_on_a_vehicle_far_from_the_described_one_no_estimate_is_worse_than_a_flat_road"
)
PAIR = "adaptive_drive::test_the_compiled_step_and_its_error_equal_the_published_pair"


class Fault(NamedTuple):
    """`old` stands once in `file`; with `new` in its place each of `tests` must fail."""

    file: str
    old: str
    new: str
    tests: str


DYNAMICS, INTEGRATOR = "road_envs/vehicle/equations.py", "road_envs/simulation/rosenbrock.py"
STRUTS = "road_envs/vehicle/struts.py"
ELIMINATION = "road_envs/simulation/block_elimination.py"
SUSPENSION, SIMULATE = "road_envs/vehicle/suspension.py", "road_envs/simulation/drive.py"
SENSORS, PROCESSING = "road_envs/sensing/data_logger.py", "road_envs/sensing/filters.py"
OBSERVABILITY = "road_envs/analysis/information_bound.py"
PARTS = "map_smoother::test_the_block_tangent_equals_the_tangent_of_the_steps"
TANGENT, LINEAR = "road_envs/simulation/sensitivity.py", "road_envs/vehicle/linear_model.py"
EARLY = "kalman_posterior::test_an_emitted_station_is_the_dense_posterior_of_the_blocks_until_then"
DRIVEN = "kalman_posterior::test_the_smoothed_profile_is_the_dense_posterior_of_all_blocks"
WHITE = "kalman_posterior::test_innovations_on_the_filters_own_model_are_white_with_unit_variance"
INTERVAL = "road_envs/simulation/control_step.py"
CURVES, SURFACE = "road_envs/vehicle/force_curves.py", "road_envs/roads/surface.py"
DATASET, CONFIG, VEHICLE = (
    "road_envs/data/recording.py",
    "road_envs/config.py",
    "road_envs/vehicle/parameters.py",
)
INDEPENDENT = "scores::test_scores_equal_an_independent_implementation"
FIELD, FAULTY = "road_envs/vehicle/perturbed_vehicle.py", "road_envs/sensing/sensor_faults.py"
ROSENBROCK, ADAPTIVE = "road_envs/simulation/ode23s.py", "road_envs/simulation/adaptive_drive.py"
STATISTICS = "leaderboard/metrics/bootstrap.py"
METRICS, SPECTRAL, BUMPS = (
    "leaderboard/metrics/heights.py",
    "leaderboard/metrics/roughness.py",
    "leaderboard/metrics/obstacles.py",
)
DEFENDER = "configs/vehicles/land_rover_defender_110.yaml"

FAULTS = [
    Fault("road_envs/simulation/sensitivity.py", "held = hd * row[K_1 + w] * twist_rate", "held = 0.0 * row[K_1 + w] * twist_rate",
          "flexible_tangent::test_the_tangent_of_a_flexible_vehicle_equals_the_finite_difference"),
    Fault("estimators/map_smoother/marginal_likelihood.py", "LikelihoodTerms(fit - log_det,", "LikelihoodTerms(fit,",
          "car_fit::test_the_smoother_adapts_to_another_vehicle_and_not_to_its_own"),
    Fault("estimators/map_smoother/tangent_likelihood.py", "gradient=fit - traces.mean(axis=0)", "gradient=fit",
          "tangent_likelihood::test_the_gradient_is_that_at_the_optimum_less_that_of_the_log_determinant"),
    Fault("estimators/map_smoother/tangent_likelihood.py", "left = G - np", "left = G + 0.0 * np",
          "tangent_likelihood::test_what_the_road_cannot_explain_is_information"),
    Fault("estimators/map_smoother/tangent_likelihood.py", "0.5 * (above - below)", "above - below",
          "tangent_likelihood::test_a_sample_of_the_trace_is_the_change_of_the_tangent_by_a_parameter"),
    Fault("estimators/map_smoother/tangent_likelihood.py", "phase + k * turn[:, None]", "phase + turn[:, None]",
          "tangent_likelihood::test_a_few_samples_average_a_quadratic_form_of_a_stationary_vehicle_exactly"),
    Fault("estimators/map_smoother/objective.py", "self.model.wheelbase / (1.0 + self.speed_error(x))",
          "self.model.wheelbase * (1.0 + self.speed_error(x))", "speed_error::test_a_wrong_speed_is_found_with_the_road"),
    Fault("estimators/common/odometer.py", "moved = first + factor * (record.s - first)", "moved = factor * record.s",
          "odometer::test_stations_speed_and_heights_follow_the_distance_scale_that_was_found"),
    Fault("estimators/map_smoother/identification.py", "SETTLING_STEPS, SETTLED = 12", "SETTLING_STEPS, SETTLED = 2",
          "car_fit::test_a_flexible_vehicle_is_recovered_from_a_drive_over_a_known_road"),
    Fault("estimators/common/footprint.py", "out[:, 0] += wide[:, :m].sum(axis=1)", "out[:, 0] += 0.0",
          "footprint::test_transpose_and_level_ends"),
    Fault("estimators/common/odometer.py", "s=record.s - share * displacement", "s=record.s",
          "odometer::test_online_the_displacement_is_found_from_the_samples_before_alone"),
    Fault("estimators/common/odometer.py", "s=record.s - displacement", "s=record.s + displacement",
          "odometer::test_the_displacement_of_an_odometer_with_position_fixes_is_found"),
    Fault("road_envs/simulation/drive.py", "surface = enveloped(surface, contact)", "pass",
          "perturbed_vehicle::test_a_record_of_s3_equals_simulator_and_faulty_data_logger"),
    Fault("estimators/map_smoother/known_road.py", '"with left and right exchanged": profile.z[::-1]', '"with left and right exchanged": profile.z',
          "car_fit::test_a_calibration_drive_that_does_not_fit_is_refused_in_one_sentence"),
    Fault("road_envs/simulation/lanes.py", "if not settled or commands[n] != commands[n - 1]:", "if not settled:",
          "lanes::test_variants_drive_as_each_of_them_alone"),
    Fault("road_envs/vehicle/tolerances.py", "return (WHEELS if size == len(WHEELS) else AXLES).index(part)", "return (WHEELS if size == len(WHEELS) else AXLES).index(part) // 2",
          "tolerances::test_a_scaled_parameter_acts_on_its_own_wheel_mass_or_curve"),
    Fault("leaderboard/evaluation/tasks.py", 'condition.grade if drives is self.test else "S0"', "condition.grade",
          "tasks::test_training_uses_the_nominal_vehicle_and_test_one_perturbed_vehicle"),
    Fault("leaderboard/evaluation/tasks.py", "(condition.mode, condition.speed_kmh))", "(condition.mode, condition.speed_kmh)) + self.conditions.index(condition)",
          "tasks::test_the_field_board_has_all_grades_on_the_same_roads"),
    Fault(STATISTICS, "[bootstrap(part, seed, replicates, strata) for part in parts]",
          "[bootstrap(part, seed + k, replicates, strata) for k, part in enumerate(parts)]",
          "scores::test_the_slope_equals_that_of_polyfit_and_its_interval_is_paired"),
    Fault("leaderboard/metrics/bound.py", "wrong / prior", "prior / wrong",
          "score_bound::test_the_third_octave_bounds_add_up_to_the_bound_of_the_band"),
    Fault("leaderboard/paper/published_figures.py", "< STATE_LIMITS[0] for scenario", "> STATE_LIMITS[0] for scenario",
          "paper::test_the_verdict_of_a_statement_follows_the_scores"),
    Fault("leaderboard/paper/figures.py", "(3 * last) // 4, last)", "last // 4, last)",
          "paper::test_sessions_are_chosen_by_their_largest_error"),
    Fault("leaderboard/paper/study.py", "if level_error < near else", "if level_error <= near else",
          "paper::test_the_states_of_appendix_a"),
    Fault("leaderboard/policies/policy_process.py",
          "if head.get(\"actions\") != self._n_vehicles:", "if False:",
          "own_policies::test_a_policy_beyond_its_limits_ends_in_a_sentence"),
    Fault("leaderboard/policies/store.py", "parts = [*self._about, name, repr(policy), learned, _code()]", "parts = [*self._about, name, learned, _code()]", "own_policies::test_finished_rows_are_kept_until_something_that_they_depend_on_changes"),
    Fault("leaderboard/commands/__init__.py", "done = share - self._first_share", "done = share", "progress::test_stored_results_do_not_count_as_fast_work"),
    Fault("leaderboard/conformance/probes.py", "LF = RF - 2.0 * y[0]", "LF = RF + 2.0 * y[0]",
          "probes::test_the_swapped_record_is_that_of_the_mirrored_road"),
    Fault("leaderboard/conformance/probes.py", "np.stack([LF, RR, LR])", "np.stack([LF, LR, RR])",
          "probes::test_the_swapped_record_is_that_of_the_mirrored_road"),
    Fault("leaderboard/conformance/probes.py", '("FR", "FL", "RR", "RL")', '("FR", "FL", "RL", "RR")',
          "probes::test_strut_states_are_swapped_with_the_accelerometers"),
    Fault("leaderboard/conformance/probes.py", "record.s >= 0.5", "record.s >= 0.6",
          "probes::test_the_future_probe_changes_only_the_second_half"),
    Fault("leaderboard/conformance/probes.py", "0.5 * record.length - lag - sample", "0.5 * record.length - 2.0 * lag - sample",
          "probes::test_an_estimator_may_use_its_declared_lag_and_not_more"),
    Fault("leaderboard/conformance/probes.py", 'similarity("swap", original[::-1])', 'similarity("swap", original)',
          "probes::test_each_defect_fails_only_its_own_probe"),
    Fault(METRICS, "float((best - reach) * ds)", "float((reach - best) * ds)", INDEPENDENT),
    Fault(METRICS, "0.5 + 0.5 * p) * sigma", "p) * sigma", INDEPENDENT),
    Fault(METRICS, "2.0 * density - 1.0 / np.sqrt(np.pi)", "density - 1.0 / np.sqrt(np.pi)", INDEPENDENT),
    Fault(METRICS, "size - size // 2]", "size]", INDEPENDENT),
    Fault(SPECTRAL, "wrong, true, out=", "true, wrong, out=", INDEPENDENT),
    Fault(SPECTRAL, "n_c * np.sqrt(2.0) <= SCORED_F_MAX", "n_c <= SCORED_F_MAX", INDEPENDENT),
    Fault("leaderboard/metrics/spectra.py", "np.abs(scored.shared(_class_steps)) <= 1", "scored.shared(_class_steps) <= 1", INDEPENDENT),
    Fault("leaderboard/report/tables.py", "np.mean(error[known] < bound[known])", "np.mean(error[known] > bound[known])",
          "results::test_entries_better_than_truth_plus_noise_and_inconsistent_baselines_are_flagged"),
    Fault("leaderboard/evaluation/surface_tasks.py", "for speed in SPEEDS_KMH:", "for speed in SPEEDS_KMH[1:]:",
          "surface_tasks::test_a_surface_is_driven_at_the_highest_speed_at_which_the_wheels_stay_down"),
    Fault("leaderboard/metrics/baselines.py", "stations + delay", "stations - delay",
          "evaluate::test_memory_is_the_training_road_without_its_delay"),
    Fault("leaderboard/evaluation/tasks.py", 'return kept if kind is None else {"kind": kind, **kept}', "return kept",
          "tasks::test_two_kinds_of_road_with_the_same_settings_have_different_digests"),
    Fault("leaderboard/evaluation/tasks.py", '{"kind": kind, **kept}', '{"kind": type(value).__name__, **kept}',
          "tasks::test_the_digest_does_not_depend_on_names_of_classes_nor_on_options_at_their_defaults"),
    Fault("road_envs/roads/composite.py", "decibels / 20.0", "decibels / 10.0",
          "composite_roads::test_a_random_level_is_uniform_in_decibels_and_leaves_the_road_as_it_is"),
    Fault(METRICS, "axis=(0, 2)).min()", "axis=(0, 2))[0]", INDEPENDENT),
    Fault(BUMPS, " and (a.height > 0.0) == (b.height > 0.0)", "", "scores::test_a_hole_does_not_match_a_bump"),
    Fault("road_envs/simulation/control_step.py", "GRAVITY * out[i, PHI, k]", "out[i, PHI, k]",
          "observation_groups::test_planar_and_strut_observations_follow_from_the_motion"),
    Fault("road_envs/simulation/instrumented_fleet.py", "interval * self.unresolved_variance_weight * unresolved", "self.unresolved_variance_weight * unresolved",
          "observation_groups::test_the_reward_is_reduced_by_the_unresolved_variance_of_the_bound"),
    Fault("road_envs/policies/groundhook.py", "(e_dot - v) * e_dot", "(e_dot + v) * e_dot",
          "policies::test_the_control_laws_are_the_published_ones"),
    Fault("road_envs/policies/sh_add.py", "alpha * np.abs(v), v, a / alpha", "np.abs(v), v, a / alpha",
          "policies::test_the_control_laws_are_the_published_ones"),
    Fault("road_envs/policies/wheelbase_preview.py", "self.k_t + tyre_compression", "self.k_t - tyre_compression",
          "policies::test_estimated_heights_under_the_front_axle_follow_the_road"),
    Fault("road_envs/policies/wheelbase_preview.py", "f @ S_a)", "-f @ S_a)",
          "policies::test_estimated_heights_under_the_front_axle_follow_the_road"),
    Fault("road_envs/policies/wheelbase_preview.py", "(self.wheelbase - distances)", "distances",
          "policies::test_front_axle_heights_move_towards_the_rear_axle"),
    Fault("road_envs/policies/preview.py", "&= ~obstacle_ahead", "&= obstacle_ahead",
          "policies::test_preview_equals_rrms_except_for_the_rear_axle_before_a_bump"),
    Fault("road_envs/policies/training.py", "rewards - every_row[1]", "rewards + every_row[1]",
          "policy_training::test_the_paired_baseline_removes_the_road_from_the_reward"),
    Fault("road_envs/envs/options.py", "self._last_road is None or self._last_road[0] != key", "True",
          "policy_training::test_the_vehicles_of_a_pair_share_one_road"),
    Fault("leaderboard/policies/summary.py", "return resample(parts, [1.0 / C] * C)", "return resample([np.concatenate(parts, axis=1)])",
          "policy_comparison::test_cases_count_equally_and_outlier_roads_are_trimmed"),
    Fault("leaderboard/policies/timeline.py", "surface.height(motion.s[sampled])", "surface.height(motion.t[sampled])",
          "policy_comparison::test_a_timeline_has_the_road_states_and_motion_of_the_drive"),
    Fault("leaderboard/policies/comparison.py", "drive.manoeuvre = prepared.setup.manoeuvre", "drive.manoeuvre = None",
          "policy_comparison::test_the_repeated_simulation_reproduces_the_costs_of_the_environment"),
    Fault("leaderboard/policies/beam_search.py", "returns = returns[keep]", "returns = returns",
          "policy_comparison::test_the_oracle_is_no_worse_than_any_fixed_pair_and_holds_its_commands"),
    Fault("leaderboard/policies/summary.py", "return resample(parts, [1.0 / C] * C)", "return resample(parts, [1.0 / C] * C, seed=int(1e6 * abs(x.mean())) % 997)",
          "policy_comparison::test_a_paired_difference_cancels_the_effect_of_the_roads"),
    Fault(STATISTICS, "seeds[part, None, :]]", "seeds[part, None, :1]]",
          "scores::test_replicates_are_distributed_as_in_a_loop_over_roads_and_seeds"),
    Fault(STATISTICS, "roads[part, :, None]", "np.arange(R)[None, :, None]",
          "scores::test_with_one_seed_the_interval_equals_that_of_scipys_bootstrap"),
    Fault(STATISTICS, "drawn[:, None] > drawn, axis=2)", "drawn[:, None] >= drawn, axis=2)",
          "scores::test_a_rank_is_one_plus_the_number_of_significantly_better_entries"),
    Fault(STATISTICS, "np.sum(x <= limit, axis=-1)", "np.sum(x > limit, axis=-1)",
          "scores::test_a_performance_profile_is_the_share_of_runs_below_each_threshold"),
    Fault("leaderboard/evaluation/hidden_seeds.py", "text = json.dumps(fields", "text = json.dumps(hidden.tasks",
          "hidden_seeds::test_an_edited_commitment_file_is_refused"),
    Fault("leaderboard/evaluation/tasks.py", "seed + k * SEED_STRIDE)", "seed)",
          "tasks::test_no_two_test_roads_share_a_seed"),
    Fault("leaderboard/evaluation/tasks.py", "families[k % len(self.roads)]", "families[k // len(self.seeds)]",
          "tasks::test_families_partition_the_test_drives"),
    Fault("road_envs/simulation/simd.py", "_constant(c.type, 0.0), a, b)", "_constant(c.type, 0.0), b, a)", LANE),
    Fault("road_envs/simulation/simd.py", "[1, 9, 3, 11, 5, 13, 7, 15]", "[1, 9, 2, 11, 5, 13, 7, 15]", LANE),
    Fault("road_envs/simulation/simd.py", "store.align = 64", "store.align = 8",
          "lanes::test_arrays_on_the_stack_are_apart_and_begin_on_cache_lines"),
    Fault("road_envs/simulation/fleet.py", "get(p.x, 0) - get(p.x, i)", "get(p.x, i) - get(p.x, 0)", LANE),
    Fault("road_envs/simulation/fleet.py", "slot = steps_delayed[k] % max(delay[k], 1)", "slot = 0",
          "fleet::test_a_fleet_in_chunks_equals_the_whole_drive_bitwise"),
    Fault("road_envs/simulation/fleet.py", "np.roll(ring, -(", "np.roll(ring, (",
          "fleet::test_a_simulator_continues_alone_after_write_back"),
    Fault(INTERVAL, "noise[k, used[k] + i, j]", "noise[k, used[k] + i, 2 - j]", SEEN),
    Fault(INTERVAL, "np.sqrt(extract_lane(rattle, k) / (4 * n))", "np.sqrt(extract_lane(rattle, k) / n)", SEEN),
    Fault(INTERVAL, "values[k, OUT_REWARD] = -n * parameters.h * cost", "values[k, OUT_REWARD] = -cost", SEEN),
    Fault(INTERVAL, "+ pitch * get(", "- pitch * get(", SEEN),
    Fault("road_envs/envs/vector.py", "self._elapsed += ~restarted", "self._elapsed += 1",
          "vector_env::test_make_vec_creates_it_and_max_episode_steps_truncates"),
    Fault("road_envs/envs/vector.py", "int(seed) + i for", "int(seed) for", SINGLE),
    Fault("road_envs/envs/vector.py", "final_info = self._infos(output, ended)",
          "final_info = self._infos(output, ~ended)", SINGLE),
    Fault("road_envs/simulation/instrumented_fleet.py", "field[b][..., lanes] = before[j][..., lanes]", "pass", SINGLE),
    Fault("road_envs/envs/sb3.py", "truncated[i] and not terminated[i]", "truncated[i] or terminated[i]",
          "sb3::test_a_failed_vehicle_is_not_reported_as_truncated"),
    Fault("road_envs/simulation/lanes.py", "constants[field] += first", "constants[field] += 0 * first", LANE),
    Fault("road_envs/simulation/fleet.py", "        if flexible is None:", "        if True:", LANE),
    Fault("road_envs/simulation/fleet.py", "byte != last[k]", "False",
          "fleet::test_every_lane_matches_its_vehicle_simulated_alone"),
    Fault("road_envs/simulation/speed.py", "0.5 * a[i] * dt", "a[i] * dt",
          "speed::test_distance_is_the_integral_of_speed"),
    Fault("road_envs/simulation/manoeuvres.py", "2.0 * np.pi * self.offset / T**2", "np.pi * self.offset / T**2",
          "manoeuvres::test_a_lane_change_moves_one_lane_over_and_back"),
    Fault(DYNAMICS, "add(out, THETA, -get(p.x, i) * push)", "add(out, THETA, get(p.x, i) * push)", PAPER_SAYS),
    Fault(DYNAMICS, "get(p.y_s, 2 * i) * (get(F", "get(p.y_t, 2 * i) * (get(F", PAPER_SAYS),
    Fault(DYNAMICS, "- get(p.k_roll, i) * roll", "+ get(p.k_roll, i) * roll", ODD_SAYS),
    Fault(DYNAMICS, "moment + get(p.twist_share, 1)", "moment - get(p.twist_share, 1)", ODD_SAYS),
    Fault(DYNAMICS, "(get(p.twist_share, w // 2) * psi)", "(get(p.twist_share, 0) * psi)", ODD_SAYS),
    Fault(DYNAMICS, "2.0 * variation.frame.zeta", "variation.frame.zeta", ODD_SAYS),
    Fault(DYNAMICS, "(1.0 - rise * deltas[w // 2])", "1.0", ODD_SAYS),
    Fault(DYNAMICS, "add_struts(p, F, -front, -rear, column)", "add_struts(p, F, front, rear, column)",
          "vehicle_variation::test_the_jacobian_matches_central_differences"),
    Fault(DYNAMICS, "twist_moment(p, F, -front, -rear)", "twist_moment(p, F, front, rear)",
          "vehicle_variation::test_the_jacobian_matches_central_differences"),
    Fault(DYNAMICS, "get(p.y_t, 2 * i) * (left - right)", "get(p.y_s, 2 * i) * (left - right)", PAPER_SAYS),
    Fault(DYNAMICS, "(get(q, PHI) - get(q, a + 1))", "(get(q, PHI) + get(q, a + 1))", PAPER_SAYS),
    Fault(DYNAMICS, "for j in (Z_B, AXLE, AXLE + 2):", "for j in (Z_B, AXLE):", PAPER_SAYS),
    Fault(DYNAMICS, "(a_y + GRAVITY * phi)", "(a_y - GRAVITY * phi)", LEAN),
    Fault(DYNAMICS, "(GRAVITY * theta - a_x)", "(GRAVITY * theta + a_x)", LEAN),
    Fault(DYNAMICS, "K[THETA, THETA] -=", "K[THETA, THETA] +=", JACOBIAN),
    Fault(DYNAMICS, "tyres[rate, w] * wheel_height(p, unit, w)", "tyres[rate, w] * e", JACOBIAN),
    Fault(DYNAMICS, "(left - right) / (y_t", "(right - left) / (y_t",
          "equations::test_an_equilibrium_is_found_on_any_plausible_ground"),
    Fault("estimators/common/block_means.py", "self.censored * (predicted - self.limit) > 0.0",
          "self.censored * (predicted - self.limit) > 1e9",
          "map_smoother::test_a_clipped_sample_is_a_limit_and_not_a_measurement"),
    Fault("estimators/map_smoother/posterior_sampling.py", "LIFTOFF_SHARE * height * error", "LIFTOFF_SHARE * error",
          "map_intervals::test_the_road_below_a_lifted_wheel_is_known_to_a_share_of_the_height_about_it"),
    Fault("estimators/map_smoother/preconditioner.py", "seen = road.free * ~unloaded",
          "seen = road.free * 1.0",
          "map_smoother::test_local_roughness_is_found_where_it_is_and_not_on_a_stationary_road"),
    Fault("estimators/map_smoother/road_prior.py",
          "e = TO_WHEEL_PATHS @ (self.free * self.local * rest)",
          "e = TO_WHEEL_PATHS @ (self.free * rest)",
          WHITENED),
    Fault("estimators/common/explained.py", "0.5 * car.wheelbase) / PROFILE_SPACING",
          "8.0 * car.wheelbase) / PROFILE_SPACING",
          "explained::test_the_share_is_local_and_its_note_gives_the_distance"),
    Fault("estimators/kalman/profile_output.py", "LOST_NOISE_SCALE, LOST_POWER_SHARE = 20.0", "LOST_NOISE_SCALE, LOST_POWER_SHARE = 1e9",
          NOT_WORSE),
    Fault("estimators/map_smoother/posterior_sampling.py",
          "+ rng.standard_normal(lin.objective.size)", "+ 0.0",
          "attainable::test_samples_have_the_covariance_of_the_dense_posterior"),
    Fault("road_envs/simulation/substeps.py", "MAX_RATE_CHANGE = 0.7", "MAX_RATE_CHANGE = 70.0",
          "substeps::test_a_millisecond_suffices_at_54_kmh"),
    Fault("road_envs/simulation/substeps.py", "maximum(maximum(change, -change), get(largest, 0))", "maximum(change, -change)",
          "substeps::test_lanes_on_steep_and_on_even_roads_match_vehicles_simulated_alone"),
    Fault("road_envs/simulation/fleet.py", "or not steep[k]:", "or steep[k]:",
          "substeps::test_lanes_on_steep_and_on_even_roads_match_vehicles_simulated_alone"),
    Fault(STRUTS, "return r * F, r * r * slope", "return F, slope",
          "passive_struts::test_a_motion_ratio_acts_once_on_forces_and_once_on_lengths"),
    Fault(STRUTS, "gas = (ATMOSPHERE * self.A + load)", "gas = load",
          "passive_struts::test_the_rate_of_an_air_spring_is_n_p_a_over_its_column"),
    Fault(DYNAMICS, "[a.k_roll + k for a", "[k for a",
          "passive_struts::test_natural_frequencies_are_those_of_four_wheels_with_bars"),
    Fault(SUSPENSION, "return factor * (load - F), -factor * slope", "return load - F, -slope",
          "passive_struts::test_a_variation_scales_spring_damper_and_friction_of_each_wheel"),
    Fault(SUSPENSION, "slope = -n_p * F / inside", "slope = -F / inside", JACOBIAN),
    Fault(SUSPENSION, "(u - u_next) * p.r_2 * e", "(u_next - u) * p.r_2 * e", VALVE),
    Fault(SUSPENSION, "deficit = (1.0 - u_next) * p.r_2", "deficit = p.r_2", VALVE),
    Fault(SUSPENSION, "np.exp(-u_next * h", "np.exp(-h",
          "suspension::test_a_closed_valve_traps_the_gas_behind_it"),
    Fault(SUSPENSION, " and strut_state[w, HELD_EXTENSION] == 0.0", "",
          "suspension::test_pressures_equalise_behind_an_open_valve_of_any_speed"),
    Fault(SUSPENSION, "if_positive(-T, 0.0, T)", "T", PAPER_SAYS),
    Fault(SUSPENSION, "T = if_positive(margin, T, T_max)", "T = T + 0.0 * margin", AIR),
    Fault(SUSPENSION, "if_positive(-x, 0.0, x)", "x", AIR),
    Fault(SUSPENSION, "if_positive(margin, slope, slope + slope)", "slope", SLOPES),
    Fault(SUSPENSION, "if_positive(excess, bend + bend, bend)", "bend", SLOPES),
    Fault(SUSPENSION, "2 * distinct.index(key)", "distinct.index(key)", ODD_SAYS),
    Fault(SUSPENSION, "stribeck.scaled(f)", "stribeck", ODD_SAYS),
    Fault(SUSPENSION, "+ c * u_dot", "- c * u_dot", PAPER_SAYS),
    Fault(SUSPENSION, "stop, k = interpolate_table(vehicle.displacement, get(p.displacement_table, w)", "stop, k = interpolate_table(vehicle.displacement, get(p.displacement_table, 0)", PAPER_SAYS),
    Fault(SUSPENSION, "low * F_0 + high * F_1", "F_0 + high * F_1", PAPER_SAYS),
    Fault(SUSPENSION, "strut_state[:, VALVE_OPEN] = ~stiff[0]", "strut_state[:, VALVE_OPEN] = stiff[0]",
          "suspension::test_with_bushing_and_stop_inactive_the_strut_force_is_equation_1"),
    Fault(SUSPENSION, "(high << (4 + w))", "(high << (3 + w))",
          "suspension::test_a_command_can_address_vehicle_axle_or_strut"),
    Fault(CURVES, "3.0 * rise - 2.0 * b", "3.0 * rise - b", TABLE),
    Fault(CURVES, "values[..., :1] - first", "values[..., :1]", TABLE),
    Fault(CURVES, "abs(slope) > 3.0 * abs(chord)", "abs(slope) > 9.0 * abs(chord)", "force_curves::test_curves_are_the_pchip_of_scipy"),
    Fault(PROCESSING, "warped**order", "warped**2", "data_logger::test_the_low_pass_is_that_of_scipy"),
    Fault(INTEGRATOR, "D = 1.0 / (2.0 + np.sqrt(2.0))", "D = 0.5", FORMULA),
    Fault(INTEGRATOR, "get(q, j) + 0.5 * h * kq", "get(q, j) + h * kq", FORMULA),
    Fault(INTEGRATOR, "get(r, j) + hd * get(f, j)", "get(r, j)", FORMULA),
    Fault(INTEGRATOR, "get(road, 4 + w)) * (2.0 / h)", "get(road, 4 + w)) / h", FORMULA),
    Fault(ELIMINATION, "a12 = a12 - x * r01", "a12 = a12 + x * r01", FORMULA),
    Fault(ELIMINATION, "hd * hd * get(p.k_roll, i)", "hd * get(p.k_roll, i)", FORMULA),
    Fault(INTEGRATOR, "psi_mid + hd * r)", "psi_mid)", FORMULA),
    Fault(INTEGRATOR, "(moment - hd * rate * psi_dot)", "moment", FORMULA),
    Fault(INTEGRATOR, "psi_mid, psi_mid_dot = psi + 0.5 * h", "psi_mid, psi_mid_dot = psi + h", FORMULA),
    Fault(INTEGRATOR, "-hd * k * rate)", "-hd * k * e_dot)", FORMULA),
    Fault(INTEGRATOR, "e += twist_extension(p, q[N_DOF], w)", "pass", SHUT),
    Fault(ELIMINATION, "hd * hd * GRAVITY * get(p.roll_moment)", "hd * GRAVITY * get(p.roll_moment)", FORMULA),
    Fault(INTEGRATOR, "(get(a_xy, 2) - a_x)", "(a_x - get(a_xy, 2))", FORMULA),
    Fault(INTEGRATOR, "get(work.q, PHI) + hd * get(r, PHI)", "get(work.q, PHI) - hd * get(r, PHI)", FORMULA),
    Fault(INTEGRATOR, "p.x[0] - p.x[w // 2]", "p.x[w // 2] - p.x[0]",
          "drive::test_each_tyre_load_follows_from_the_road_at_its_own_station"),
    Fault(INTEGRATOR, "s[2 * n + 1], v[2 * n + 1]", "s[2 * n], v[2 * n]",
          "rosenbrock::test_the_method_has_order_two_on_the_nonlinear_vehicle_over_a_road"),
    Fault(INTEGRATOR, "alpha = 1.0 - np.exp(-h / lag)", "alpha = 1.0 - np.exp(-0.5 * h / lag)",
          "drive::test_a_switch_is_95_percent_complete_after_50_milliseconds"),
    Fault(SIMULATE, "car.valve.delay / step", "car.valve.delay / 0.001",
          "drive::test_a_command_has_no_effect_before_the_delay_of_the_valve"),
    Fault(SIMULATE, "2 * done + np.arange", "done + np.arange", WHOLE),
    Fault(SIMULATE, "0.5 * np.sign(x) * y", "0.5 * y",
          "varied_drives::test_a_body_point_moves_with_its_half_of_the_frame"),
    Fault(SIMULATE, "- x * a[:, THETA]", "+ x * a[:, THETA]",
          "drive::test_the_acceleration_of_a_body_point_is_that_of_the_rigid_body"),
    Fault(VEHICLE, "return -0.5 * weight * self.rear.x, 0.5 * weight * self.front.x",
          "return 0.5 * weight * self.front.x, -0.5 * weight * self.rear.x",
          "vehicle::test_loads_add_up_to_the_weight_and_balance_about_the_centre_of_mass"),
    Fault(VEHICLE, "GRAVITY = 9.81", "GRAVITY = 9.80665", PAPER_SAYS),
    Fault(DEFENDER, "I_yy: 2440.0", "I_yy: 2400.0",
          "equations::test_the_equations_have_the_published_natural_frequencies"),
    Fault(DEFENDER, "-1440.0, -1050.0, -350.0", "-1440.0, -350.0, -350.0",
          "suspension::test_handling_damping_exceeds_ride_damping_at_every_velocity"),
    Fault(DEFENDER, "delay: 0.02", "delay: 0.03",
          "suspension::test_the_shipped_valve_reaches_95_percent_within_50_ms"),
    Fault(SENSORS, "np.sqrt(0.5 / step)", "np.sqrt(1.0 / step)",
          "data_logger::test_noise_has_its_density_at_every_integrator_step"),
    Fault(SENSORS, "np.clip(a, -self.range[:, None],", "np.clip(a, -np.inf,",
          "data_logger::test_clipping_happens_before_the_antialias_filter"),
    Fault("road_envs/sensing/instruments.py", "0.0) + sensor.ahead", "0.0) - sensor.ahead", PLACED),
    Fault(SENSORS, "-self.n_steps % self.decimation", "self.n_steps % self.decimation",
          "data_logger::test_sampling_in_chunks_equals_sampling_at_once_to_the_bit"),
    Fault(SENSORS, "standard_normal(a.shape[::-1]).T", "standard_normal(a.shape)",
          "data_logger::test_sampling_in_chunks_equals_sampling_at_once_to_the_bit"),
    Fault(CURVES, "(2.0 * c + 6.0 * d * t)", "(2.0 * c + 3.0 * d * t)", DUALS),
    Fault(CURVES, "minimum(maximum(u, 0.0), cells - 1.0)", "minimum(maximum(u, 1.0), cells - 1.0)",
          "sensitivity::test_the_second_derivative_of_a_table_is_the_slope_of_its_slope"),
    Fault(SUSPENSION, "-(get(p.n_p) + 1.0) * slope", "-get(p.n_p) * slope", DUALS),
    Fault(SUSPENSION, "stop - share * share * gas", "stop - share * gas", DUALS),
    Fault(SUSPENSION, "if_positive(column - get(p.column_min), bend, 0.0)", "bend", DUALS),
    Fault(SUSPENSION, "(1.0 - high) * c_0 + high * c_1", "c_0 + high * c_1", DUALS),
    Fault(TANGENT, "k_slope * (e_dot + hd * first)", "k_slope * e_dot", DUALS),
    Fault(TANGENT, "hd * c_slope * second", "0.0", DUALS),
    Fault(TANGENT, "hd * k_slope * (u_dot - hd * first)", "hd * k_slope * u_dot", DUALS),
    Fault(TANGENT, "(wheel_height(p, work.r, w) + hd * second)", "wheel_height(p, work.r, w)", DUALS),
    Fault(TANGENT, "(c_t + hd * k_t) * u_dot", "c_t * u_dot", DUALS),
    Fault(TANGENT, "front + hd * relative_roll(v, 0)", "front", DUALS),
    Fault(TANGENT, "k_t * direct + road[w]", "k_t * direct", TRANSPOSE),
    Fault(TANGENT, "F, hd * front, hd * rear, r)", "F, 0.0, 0.0, r)", TRANSPOSE),
    Fault(TANGENT, "- row[C_2 + w] * e_dot", "+ row[C_2 + w] * e_dot", DUALS),
    Fault(TANGENT, "(2.0 * D * c_t) * (get", "(D * c_t) * (get", DUALS),
    Fault(TANGENT, "get(q, PHI) + hd * get(v, PHI)", "get(q, PHI)", DUALS),
    Fault(TANGENT, "- p.M[j] * f[j]", "+ p.M[j] * f[j]", TRANSPOSE),
    Fault(TANGENT, "0.5 * h * v[j] + hd * work.k_q[j]", "0.5 * h * v[j]", TRANSPOSE),
    Fault(TANGENT, "hd * f[THETA], 0.0, 0.0, r)", "f[THETA], 0.0, 0.0, r)", TRANSPOSE),
    Fault(TANGENT, "z_dot - difference", "z_dot", TRANSPOSE),
    Fault("road_envs/simulation/tape.py", "- 1, -1, -1)", "- 1, 0, -1)",
          "sensitivity::test_the_adjoint_of_a_drive_is_the_transpose_of_its_tangent"),
    Fault(DYNAMICS, "= 1.0, y, -x", "= 1.0, y, x",
          "linear_model::test_about_any_state_the_model_matches_differences"),
    Fault(LINEAR, "rows.T * c_t", "rows.T * k_t",
          "linear_model::test_at_equilibrium_the_model_matches_the_energy_matrices"),
    Fault(DYNAMICS, "row[N_DOF] = 0.5 * np.sign(x) * y", "row[N_DOF] = 0.5 * y",
          "varied_drives::test_about_any_state_the_linear_model_matches_differences"),
    Fault(LINEAR, "u_dot = z - rows @ y[:n], w - rows", "u_dot = z + rows @ y[:n], w + rows",
          "linear_model::test_about_any_state_the_model_matches_differences"),
    Fault(LINEAR, "np.array(current) - target", "np.array(current) + target",
          "linear_model::test_given_damping_replaces_the_strut_slopes_in_the_model"),
    Fault(LINEAR, "weight /= weight @ x", "weight /= weight @ weight",
          "linear_model::test_gaussian_damping_is_the_least_squares_damper_for_a_normal_rate"),
    Fault(LINEAR, "(2.0 * omega)", "omega",
          "linear_model::test_poles_of_a_lightly_damped_car_match_modal_damping_ratios"),
    Fault(LINEAR, "names[column] = name", "names[column] = name[::-1]",
          "linear_model::test_the_defender_has_the_tabulated_natural_modes"),
    Fault(LINEAR, "+ model.D\n    return inputs[:, :, :4] + s", "+ model.D\n    return inputs[:, :, :4] - s",
          "linear_model::test_the_frequency_response_matches_a_scipy_simulation"),
    Fault(LINEAR, "np.exp(-2j * np.pi * f", "np.exp(2j * np.pi * f",
          "linear_model::test_rear_wheels_respond_with_the_wheelbase_delay"),
    Fault(PROCESSING, "f_c: float = F_C", "f_c: float = 1.2 * F_C",
          "data_logger::test_offline_processing_is_6_db_down_at_25_hertz_without_delay"),
    Fault(PROCESSING, "a - a.mean(axis=1, keepdims=True)", "a",
          "data_logger::test_processing_removes_the_mean"),
    Fault(DATASET, "logger.speed_gain * v", "v",
          "recording::test_the_odometer_integrates_the_measured_speed"),
    Fault(DATASET, "step = min(step, one.step)", "step = step", GRADED),
    Fault(DATASET, "return record, true_profile(surface)", "return record, truth(felt)", GRADED),
    Fault(DATASET, "[*parts, logger.flush()]", "parts", GRADED),
    Fault(SENSORS, "np.expm1(-distance / length)", "np.expm1(-0.5 * distance / length)",
          "sensor_faults::test_position_fixes_bound_the_odometer_error"),
    Fault(SENSORS, "y=location.y + float(dy)", "y=location.y", MOUNTED),
    Fault(SIMULATE, "+ y * a[:, AXLE", "- y * a[:, AXLE", LAYOUT),
    Fault("estimators/preprocessing.py", "rows = [record.channels.index(name) for name in channels]",
          "rows = [0, 1, 2]",
          "accelerometer_layouts_estimated::test_the_order_of_the_sensors_does_not_matter"),
    Fault("road_envs/sensing/instruments.py", 'mounted == "front axle" else 1', 'mounted == "front axle" else 0',
          "accelerometer_layouts_estimated::test_sensors_on_the_axles_tell_more_than_one_on_the_body"),
    Fault(DYNAMICS, "AXLE + 2 * axle + 1]] = 1.0, y", "AXLE + 2 * axle + 1]] = 1.0, -y",
          "accelerometer_layouts::test_the_linear_model_has_rows_of_the_axles"),
    Fault("road_envs/simulation/instrumented_fleet.py", "0: [AXLE, AXLE + 1,", "0: [AXLE, PHI,",
          "accelerometer_layouts::test_an_environment_observes_the_sensors_of_its_instruments"),
    Fault(FAULTY, "gain * GRAVITY * (axis_cosine - 1.0)", "GRAVITY * (axis_cosine - 1.0)", MOUNTED),
    Fault(FAULTY, "rate / (length * (1.0 - rate))", "rate / length", LOST),
    Fault(FAULTY, "self.dropout_left < 0 and", "self.dropout_left <= 0 and", LOST),
    Fault(FAULTY, "else end - self.margin) - 1", "else end) - 1",
          "sensor_faults::test_a_stream_in_chunks_yields_the_samples_of_the_whole"),
    Fault(FIELD, "rng.choice((-1.0, 1.0))", "rng.choice((1.0, 1.0))",
          "perturbed_vehicle::test_draws_cover_their_ranges_in_both_directions"),
    Fault(FIELD, "spawn_key=(*root.spawn_key, PERTURBATION_STREAM, group)", "spawn_key=(PERTURBATION_STREAM, group)",
          "perturbed_vehicle::test_a_seed_is_reproducible_and_its_sequence_is_not_modified"),
    Fault(SURFACE, "begin + x * (end - begin)", "begin + 0.5 * (end - begin)", FELT),
    Fault(SURFACE, "+ (s - ends[i]) * mean_between(ends[i], s)", "", FELT),
    Fault(DATASET, "pq.write_table(table, partial)", "pq.write_table(table, path)",
          "recording::test_a_failed_write_keeps_the_old_file_and_leaves_no_other"),
    Fault(SURFACE, "q = a - 2.5 * b", "q = a - 2.0 * b", CUBIC),
    Fault(SURFACE, "(p + x * (2.0 * q + x * 3.0 * r)) * per_ds", "p + x * (q + x * r)", CUBIC),
    Fault(SURFACE, "padded.shape[1] - 3.0", "padded.shape[1] - 4.0", CUBIC),
    Fault(CONFIG, '"extra": "forbid"', '"extra": "ignore"', REFUSED),
    Fault(CONFIG, "(text, strict=True)", "(text, strict=False)", REFUSED),
    Fault(CONFIG, "if _is_constrained(hint)}", "if False}",
          "config::test_direct_construction_refuses_a_value_with_the_same_message"),
    Fault(CONFIG, "if name in seen:", "if False:",
          "config::test_an_invalid_configuration_file_is_rejected_with_its_path"),
    Fault(ROSENBROCK, "E_32 = 6.0 + np.sqrt(2.0)", "E_32 = 6.0 - np.sqrt(2.0)", THIRD),
    Fault(ROSENBROCK, "- 2.0 * (k_1 - F_0) + h * D * T)", "- 2.0 * (k_1 - F_0))", THIRD),
    Fault(ROSENBROCK, "k_1 = solve(F_0 + h * D * T)", "k_1 = solve(F_0)", THIRD),
    Fault(ROSENBROCK, "rate(t + 0.5 * h, y + 0.5", "rate(t, y + 0.5",
          "ode23s::test_at_a_constant_step_the_method_has_order_two_on_a_time_dependent_rate"),
    Fault(ROSENBROCK, "x * (x - 2.0 * D) /", "x * (x - D) /",
          "ode23s::test_dense_output_is_as_accurate_as_the_steps"),
    Fault(ROSENBROCK, "error ** (-1.0 / 3.0)", "error ** (-1.0 / 2.0)",
          "ode23s::test_the_step_size_factor_is_a_limited_cube_root_of_the_error"),
    Fault(ROSENBROCK, "new.y, new.F\n", "new.y, F\n",
          "ode23s::test_at_a_constant_step_the_method_has_order_two_on_a_time_dependent_rate"),
    Fault(ADAPTIVE, "- E_32 * (k_2v - at_middle[j])", "+ E_32 * (k_2v - at_middle[j])", PAIR),
    Fault(ADAPTIVE, "work.T[w] = work.dT[w] + hd", "work.T[w] = work.dT[w] - hd", PAIR),
    Fault(ADAPTIVE, "add_tyres(p, work.T, R_v)", "", PAIR),
    Fault(ADAPTIVE, "hd * relative_roll(R_q, 0)", "relative_roll(R_q, 0)", PAIR),
    Fault(ADAPTIVE, "b_1 * work.g[j] + b_2 * k_2v", "b_1 * work.g[j] + b_2 * work.g[j]", PAIR),
    Fault(ADAPTIVE, "y[:] = signals_0[: 2 * N_DOF]", "pass",
          "adaptive_drive::test_every_signal_matches_the_drive_in_small_fixed_steps"),
    Fault(ADAPTIVE, "(now + 0.5 * k * h)", "(now + 0.25 * k * h)",
          "adaptive_drive::test_the_drive_converges_to_scipys_radau_with_the_tolerance"),
    Fault(OBSERVABILITY, "noise = np.maximum(densities, 1e-9) ** 2 * v",
          "noise = np.maximum(densities, 1e-9) ** 2", BOUND),
    Fault(OBSERVABILITY, "R + model_error**2", "R + model_error",
          "information_bound::test_the_bound_reproduces_the_benchmark_table"),
    Fault(OBSERVABILITY, "0.5 * (error + _adjoint(error))", "error + _adjoint(error)", BOUND),
    Fault(OBSERVABILITY, "H[n * v > f_c] = 0.0", "pass",
          "information_bound::test_no_information_is_gained_above_the_low_pass"),
    Fault(OBSERVABILITY, "known.get(which, (1.0, -1.0))", "known.get(which, (0.5, 0.5))",
          "information_bound::test_mean_and_difference_follow_from_the_wheel_paths"),
    Fault(OBSERVABILITY, "prior.spectrum(f / v) / v", "prior.spectrum(f / v)",
          "information_bound::test_the_equivalent_damping_is_a_fixed_point_of_linearization"),
    Fault(LINEAR, "inside[:, model.M.size :]", "inside[:, : model.M.size]",
          "information_bound::test_the_strut_rate_is_the_difference_of_its_ends"),
    Fault("estimators/map_smoother/block_tangent.py", "= w[k] * track.node_rate[now]", "= w[k]", PARTS),
    Fault("estimators/map_smoother/block_tangent.py", "if n % decimation == 0:", "if True:", PARTS),
    Fault("estimators/map_smoother/block_tangent.py", "(begun + LANES - 1) // LANES", "begun // LANES", PARTS),
    Fault("estimators/map_smoother/block_tangent.py", "r3 * get(P, m, column, 3)\n            out", "r2 * get(P, m, column, 3)\n            out",
          "map_smoother::test_the_adjoint_transposes_the_tangent_and_the_hessian_is_gauss_newton"),
    Fault("estimators/map_smoother/objective.py", "x = np.concatenate([u.ravel(), self.x[u.size :]])", "x = self.x",
          "map_smoother::test_an_update_of_the_prior_changes_neither_road_nor_motion"),
    Fault("estimators/wiener/smoother.py", "CONVERGED = 0.02", "CONVERGED = 0.5",
          "wiener::test_iterations_that_end_early_find_the_road_of_all_of_them"),
    Fault("estimators/networks/levenberg_marquardt.py", "np.sum(D_e * weights.T, axis=1)", "np.sum(D_e, axis=1)",
          "levenberg_marquardt::test_the_normal_equations_agree_with_automatic_differentiation"),
    Fault("estimators/map_smoother/windows.py", "state, strut_state = objective.state_after(x, steps)", "objective.state_after(x, steps)",
          "map_smoother::test_joined_windows_agree_with_one_window_within_its_std"),
    Fault("estimators/map_smoother/wheel_liftoff.py", "(max_load < LIFTOFF_LOAD_SHARE", "(max_load < -LIFTOFF_LOAD_SHARE",
          "map_smoother::test_under_a_lifted_wheel_the_road_is_not_raised"),
    Fault("estimators/map_smoother/gauss_newton.py", "return noise_scale / np.interp(", "return noise_scale / np.interp(0.0 * ",
          "map_smoother::test_a_tone_outside_the_model_is_down_weighted_at_its_frequency"),
    Fault("estimators/map_smoother/objective.py", "apply_frequency_weights(np.sqrt(self.frequency_weights), white)", "apply_frequency_weights(self.frequency_weights, white)",
          "map_smoother::test_drawn_noise_has_the_inverse_covariance_of_the_cost"),
    Fault("estimators/map_smoother/joint_objective.py", "            total += c\n", "            total = c\n",
          "joint_passes::test_the_adjoint_transposes_the_tangent_of_all_passes"),
    Fault("estimators/map_smoother/joint_objective.py", "(shift @ self._hats) * self._slope", "(shift @ self._hats) * -self._slope",
          "joint_passes::test_a_shift_of_a_pass_changes_its_readings_as_the_tangent_predicts"),
    Fault("estimators/map_smoother/joint_objective.py", "np.einsum(\"fij,fji->f\", covariance, one", "np.einsum(\"fij,fij->f\", covariance, one",
          "joint_passes::test_information_and_degrees_of_freedom_of_the_passes_add"),
    Fault("road_envs/analysis/alignment.py", "shift = np.interp(stations, own, shifts)", "shift = 0.0 * np.interp(stations, own, shifts)",
          "station_maps::test_an_odometer_that_position_fixes_pull_back_is_followed"),
    Fault("estimators/passes.py", "weight = inside[:, None] / variance", "weight = inside[:, None] / np.sqrt(variance)",
          "passes::test_the_mean_is_weighted_by_inverse_variance_and_its_error_is_that_of_the_weights"),
    Fault("road_envs/analysis/information_bound.py", "R[:, inside, inside], first = one, inside.stop", "R[:, inside, inside], first = 2.0 * one, inside.stop",
          "information_bound::test_the_information_of_passes_adds_in_a_case_solved_exactly"),
    Fault("estimators/common/road_prior.py", "np.sin(np.pi * k * ds) /", "np.sin(np.pi * n * ds) /",
          "map_smoother::test_the_prior_density_is_flat_below_its_lowest_frequency"),
    Fault("estimators/common/road_prior.py", "rise = 2.0 *", "rise = 1.9 *",
          "map_smoother::test_roads_drawn_from_the_prior_have_its_density_and_coherence"),
    Fault("estimators/map_smoother/objective.py", "self.x - self.adjoint", "self.adjoint",
          "map_smoother::test_the_gradient_equals_finite_differences_of_the_cost"),
    Fault("estimators/map_smoother/objective.py", "count / self.model.noise", "count / 2.0 / self.model.noise",
          "map_smoother::test_on_a_linear_vehicle_the_map_road_is_the_dense_gaussian_posterior"),
    Fault("estimators/linear/fir_bank.py", "share * (1.0 - share) * XX", "share * XX",
          "spatial_signals::test_the_normal_equations_equal_least_squares_with_penalty_rows"),
    Fault("estimators/linear/fir_bank.py", "(self.off_diagonal[k] - smoothness).T", "self.off_diagonal[k].T",
          "spatial_signals::test_the_normal_equations_equal_least_squares_with_penalty_rows"),
    Fault("estimators/linear/fir_bank.py", "(k == knot) * (1.0 - above)", "(k == knot) * above",
          "spatial_signals::test_taps_are_interpolated_between_speeds_and_states_at_each_station"),
    Fault("estimators/common/spatial_signals.py", "0.5 * (lr + rr), roll]", "0.5 * (lr + rf), roll]",
          "spatial_signals::test_front_and_rear_motions_exclude_roll_and_roll_excludes_heave_and_pitch"),
    Fault("estimators/common/spatial_signals.py", "F_C, causal)", "F_C)",
          "spatial_signals::test_causal_signals_are_independent_of_samples_beyond_the_filter_reach"),
    Fault("estimators/networks/trainer.py", "{**current, \"state\": moments}", "current",
          "trainer::test_an_interrupted_training_gives_the_same_weights_to_the_bit"),
    Fault("estimators/networks/trainer.py", "if error < self.best_error:", "if True:",
          "trainer::test_the_weights_of_the_smallest_validation_error_are_kept"),
    Fault("estimators/networks/trainer.py", "residual * MIRROR_SIGNS[6:8]", "residual * MIRROR_SIGNS[5:7]",
          "trainer::test_a_mirrored_crop_has_roll_and_half_difference_negated"),
    Fault("estimators/networks/narx.py", "if k >= d else", "if k > d else",
          "narx::test_in_parallel_the_network_feeds_back_its_own_outputs"),
    Fault("estimators/preprocessing.py", "np.maximum.accumulate(record.s)", "record.s",
          f"{CONTRACT}refuses_the_same_records_with_the_same_sentence"),
    Fault("estimators/preprocessing.py", "FS_MIN = 2.4 * F_C", "FS_MIN = 1.9 * F_C",
          f"{CONTRACT}refuses_the_same_records_with_the_same_sentence"),
    Fault("estimators/preprocessing.py", "2 * ANTIALIAS_SPREAD + 1", "2 * ANTIALIAS_SPREAD - 1",
          "model_inputs::test_samples_near_a_clipped_or_missing_one_are_invalid"),
    Fault("estimators/preprocessing.py", "t + 0.5 * dt) - 1", "t + 1.5 * dt) - 1",
          "preprocessing::test_dropped_samples_are_restored_at_their_times"),
    Fault("estimators/map_smoother/estimator.py", "record, valid, notes = mask_record(record, instruments)",
          "valid, notes = mask_record(record, instruments)[1:]",
          f"{CONTRACT}takes_the_same_damaged_records_with_the_same_note"),
    Fault("estimators/baselines/flat.py", "mask_record(record).notes", "()",
          f"{CONTRACT}refuses_the_same_records_with_the_same_sentence"),
    Fault("leaderboard/evaluation/pretraining.py", "== self.digest", "!= \"\"",
          "pretraining::test_an_unfinished_state_of_another_purpose_is_ignored"),
    Fault("leaderboard/running/plan.py", "if self._may_be_altered:", "if False:",
          "board::test_files_altered_during_a_run_are_detected_and_made_again"),
    Fault("leaderboard/running/plan.py", "if result.failure is None:", "if True:",
          "board::test_failures_are_run_again_and_end_the_other_conditions_of_the_entry"),
    Fault("leaderboard/evaluation/store.py", "if text_checksum(text) != checksum:", "if False:",
          "results::test_the_checksum_covers_every_byte_below_it"),
    Fault("leaderboard/running/jobs.py", '"seeds": list(seeds),', "",
          "board::test_a_change_reruns_only_the_results_that_depend_on_it"),
    Fault("leaderboard/running/job_files.py", 'if value.get("kind") == "measured"', "if False",
          "board::test_planned_jobs_need_no_other_file"),
    Fault("leaderboard/running/executors.py", "self._idle.append(process)", "process.close()",
          "executors::test_jobs_with_entries_of_this_package_share_a_process_and_its_guest"),
    Fault("leaderboard/sandbox/client.py", "str(self._code.get(reference, reference))", "reference",
          "board::test_planned_jobs_need_no_other_file"),
    Fault("road_envs/_atomic_io.py", "        partial.unlink(missing_ok=True)\n\n\ndef write_text", "        pass\n\n\ndef write_text",
          "atomic_io::test_a_failed_write_leaves_only_the_old_file"),
    Fault("leaderboard/sandbox/guest.py", "if size > messages.MAX_HEAD:", "if size < 0:",
          "guest_replies::test_a_malformed_reply_is_one_sentence"),
    Fault("leaderboard/sandbox/messages.py", "not 0 <= value <= largest", "not value <= largest",
          "guest_replies::test_a_malformed_reply_is_one_sentence"),
    Fault("leaderboard/sandbox/client.py", "if largest > LARGEST_HEIGHT:", "if largest < 0:",
          "guest_replies::test_a_malformed_reply_is_one_sentence"),
    Fault("leaderboard/sandbox/client.py", "reported if used < reported + UNSEEN_TIME else used", "reported",
          "sandbox::test_the_processor_time_of_all_threads_counts"),
    Fault("leaderboard/sandbox/bubblewrap.py", '"--unshare-pid", "--unshare-net"', '"--unshare-pid"',
          "sandbox::test_an_entry_has_no_network_in_bubblewrap"),
    Fault("leaderboard/sandbox/client.py", "first = start - entry.lag - float", "first = -entry.lag - float",
          "hostile_entries::test_what_an_entry_claims_falsely_is_shown"),
    Fault("leaderboard/evaluation/entries.py", "elif name.lower() in RESERVED:", "elif name in ():",
          "hostile_entries::test_every_entry_has_its_row_and_every_failure_its_sentence"),
    Fault("road_envs/analysis/statistical_linearization.py", "        R += np.outer(a[k], a[k])\n        R *= rho", "        R += np.outer(a[k], a[k]) * rho",
          "statistical_linearization::test_the_residual_of_a_cube_is_the_triple_convolution"),
    Fault("estimators/wiener/spectral_model.py", "np.real(np.einsum(\"fii->f\", matrices))", "np.abs(matrices[:, 0, 0])",
          "wiener::test_the_noise_scale_is_separated_from_the_road_level"),
    Fault("estimators/wiener/smoother.py", "q += RELAXATION * (expected - q)", "q -= RELAXATION * (expected - q)",
          "wiener::test_subtracting_the_force_residuals_reduces_the_error"),
    Fault("estimators/networks/std_calibration.py", "np.log(n_std) for _, n_std in COV", "np.log(n_std) for n_std, _ in COV",
          "std_calibration::test_factors_depending_on_speed_states_and_level_are_recovered"),
    Fault("leaderboard/evaluation/pretraining.py", "corpus.simulate_drive(k, True)", "corpus.simulate_drive(k)",
          "std_calibration::test_the_command_trains_and_then_calibrates_on_the_nominal_vehicle"),
    Fault("estimators/networks/sequence_estimator.py", "factors * inputs.level", "inputs.level",
          "std_calibration::test_shipped_intervals_have_the_stated_coverage_on_the_main_board"),
    Fault("estimators/wiener/spectral_model.py", "shape = _shrunk_band_means(level_per_line / level, octave, ROAD_OCTAVES.size)", "pass",
          "wiener::test_a_waviness_other_than_the_prior_is_estimated"),
    Fault("estimators/roughness/rms_regression.py", "inverse - np.outer(alpha, alpha)", "inverse + np.outer(alpha, alpha)",
          "rms_regression::test_the_marginal_likelihood_is_the_outputs_density_and_its_gradient_matches"),
    Fault("estimators/roughness/rms_regression.py", "np.diag(own) + noise -", "np.diag(own) -",
          "rms_regression::test_a_prediction_is_the_conditional_of_the_joint_density"),
    Fault("road_envs/data/training_corpus.py", "w=rng.uniform(1.6, 2.4)", "w=rng.uniform(1.6, 2.5)",
          "pretrained_weights::test_shipped_fir_taps_match_the_corpus_as_simulated_now"),
    Fault("estimators/linear/inverse_quarter_car.py", "(m_u * p**2 * z_u + m_s)", "(m_u * p**2 * z_u)",
          "inverse_quarter_car::test_it_is_the_inverse_of_the_quarter_car_in_state_space"),
    Fault("estimators/linear/inverse_quarter_car.py", "(z[2:], wheelbase)", "(z[2:], 0.0)",
          "inverse_quarter_car::test_of_the_difference_a_comb_over_three_wheelbases_is_recovered"),
    Fault("estimators/linear/inverse_quarter_car.py", "np.array([-car.rear.x, car.front.x])", "np.array([car.front.x, -car.rear.x])",
          "inverse_quarter_car::test_the_corners_of_the_defender_match_its_parameters"),
    Fault("estimators/linear/impulse_responses.py", "np.append(np.full(N_TAPS - 1, 1.0 - decay), 1.0)", "np.full(N_TAPS, 1.0 - decay)",
          "calibrated_fir::test_the_kernel_is_that_of_chen_ohlsson_and_ljung"),
    Fault("estimators/linear/impulse_responses.py", "F_BODY / RATE * np.arange", "0.0 / RATE * np.arange",
          "calibrated_fir::test_the_long_wave_gain_is_the_motion_in_phase_with_the_road_at_half_a_hertz"),
    Fault("estimators/linear/road_posterior.py", "np.log(misfit / data.n)", "np.log(misfit / data.n) + 0.3",
          "calibrated_fir::test_the_posterior_module_solves_for_the_most_probable_settings"),
    Fault("estimators/linear/road_posterior.py", "bands[1, ::2] = -path", "bands[1, ::2] = 0.0",
          "calibrated_fir::test_the_banded_posterior_is_the_dense_one"),
    Fault("estimators/linear/road_posterior.py", 'np.einsum("ij,jxpt->xpti", mix,', 'np.einsum("ij,jxpt->xpti", np.eye(len(mix)),',
          "calibrated_fir::test_the_banded_posterior_is_the_dense_one"),
    Fault("estimators/networks/sequence_estimator.py", "for drive in drives if drive.rigid]", "for drive in drives]",
          "std_calibration::test_the_command_trains_and_then_calibrates_on_the_nominal_vehicle"),
    Fault("estimators/common/spatial_signals.py", "[front - rear, roll - rear]", "[front - roll, roll - rear]",
          "spatial_signals::test_power_ratios_compare_motions_band_by_band"),
    Fault("estimators/common/vehicle_correction.py", "bool((state == self.state).all() and near)", "bool(near)",
          "vehicle_correction::test_a_correction_serves_its_own_state_and_speed_only"),
    Fault("estimators/kalman/road_process.py", "variance += weight * row[node_index(newest_node - k, K) + component]", "pass",
          EARLY),
    Fault("estimators/kalman/road_process.py", "x[M], x[M + 1] = c * real - s * imaginary, s * real + c * imaginary", "x[M], x[M + 1] = c * real, c * imaginary",
          EARLY),
    Fault("estimators/kalman/road_process.py", "adaptive[ROUGHNESS_SUM] / adaptive[ROUGHNESS_WEIGHT], MIN_ROUGHNESS_SCALE", "1.0, MIN_ROUGHNESS_SCALE",
          "kalman::test_the_roughness_scale_is_estimated_within_a_factor_of_two"),
    Fault("estimators/kalman/road_process.py", "np.append(phi, 0.0) - np.append(0.0, phi)", "np.append(phi, 0.0)",
          "kalman::test_simulated_ar_roads_have_the_density_and_coherence_of_the_prior"),
    Fault("estimators/kalman/filter.py", "variance -= cross[r] ** 2", "pass",
          EARLY),
    Fault("estimators/kalman/filter.py", "inverse_std *= np.sqrt(hazard * (hazard - limit))", "pass",
          "kalman_posterior::test_a_censored_measurement_gives_the_moments_of_a_truncated_normal"),
    Fault("leaderboard/report/attainable.py", "(error / own) ** 2", "error / own",
          "board_attainable::test_every_drive_is_computed_once_and_efficiency_is_relative_to_it"),
    Fault("leaderboard/report/attainable.py", 'task.grade(task.test, condition) == "S0" and task.bound', "True",
          "board_attainable::test_drives_of_perturbed_vehicles_and_tasks_without_a_bound_have_none"),
    Fault("estimators/kalman/monitoring.py", "ahead = min(NIS_AHEAD, lag - NIS_CELL)", "ahead = NIS_AHEAD",
          "kalman::test_the_local_nis_is_that_of_both_axles_and_no_later_than_the_lag"),
    Fault("estimators/kalman/estimators.py", "z_std *= np.sqrt(", "z_std *= 1.0 + 0.0 * np.sqrt(",
          "kalman::test_intervals_widen_where_obstacles_surprise_the_filter"),
    Fault("road_envs/_numba.py", "passes.run(self._final_module, *options)", "pass",
          "rosenbrock::test_a_step_takes_no_longer_than_500_dependent_multiply_adds"),
    Fault("estimators/kalman/filter.py", "pending[rank - 3 + s, first + i] = z", "pass",
          EARLY),
    Fault("estimators/kalman/filter.py", "innovation[s] -= cross[r] * innovation[r]", "pass",
          WHITE),
    Fault("estimators/kalman/linearization.py", "sign = -1.0 if component == 1 and side == 1 else 1.0", "sign = 1.0",
          EARLY),
    Fault("estimators/kalman/linearization.py", "H[s, size] = 1.0", "pass",
          EARLY),
    Fault("estimators/kalman/profile_output.py", "u[1] = -0.5 * decay * np.exp(-x) * (np.cos(x) - np.sin(x))", "u[1] = 0.0",
          EARLY),
    Fault("estimators/kalman/friction_linearization.py", "variance - cross**2 / (x**2 @ weight)", "variance",
          "kalman::test_the_statistical_linearization_is_the_best_line_through_sampled_forces"),
    Fault("estimators/kalman/rts_smoother.py", "smoothing_error[s] -= V[s, k] * r[k]", "pass",
          DRIVEN),
    Fault("estimators/kalman/rts_smoother.py", "VNV[s, s] += 1.0", "pass",
          DRIVEN),
    Fault("estimators/kalman/pipeline.py", "t = sensor_latency + h", "t = h",
          "kalman::test_later_samples_leave_emitted_stations_unchanged_even_if_they_clip"),
    Fault("estimators/roughness/spectral.py", "levels[k] /= 2.0", "pass",
          "spectral_roughness::test_octaves_have_the_levels_and_classes_of_the_road"),
    Fault("road_envs/data/measured_record.py", "s = s - s[0] + wheelbase", "s = s - s[0]",
          "measured_record::test_the_estimated_road_of_a_measured_record_is_the_driven_road"),
    Fault("road_envs/data/logger_tables/clock.py", "reach = JITTER_REACH if", "reach = 0.02 if",
          "logger_tables::test_a_jittering_clock_loses_no_sample_and_keeps_the_signal"),
    Fault("road_envs/data/logger_tables/channels.py", "        return a - mean\n", "        return a\n",
          "measured_record::test_units_follow_from_column_names_and_gravity_from_the_mean"),
    Fault("leaderboard/drive_report/posterior_iri.py", "n[inside] ** -2.0", "n[inside] ** -1.0",
          "drive_report::test_the_error_has_unit_variance_in_the_band_and_falls_with_the_square_of_frequency"),
    Fault("estimators/wiener/drive_check.py", "np.arange(len(record.channels)) == k, -1.0", "np.arange(len(record.channels)) == k, 1.0",
          "drive_check::test_one_of_the_other_readings_is_the_right_one"),
    Fault("estimators/wiener/drive_check.py", "described[0] - other[0]", "other[0] - described[0]",
          "drive_check::test_a_wrong_mode_is_noticed_and_the_right_one_is_not_doubted"),
    Fault("leaderboard/metrics/agreement.py", "between_columns - rest) / n", "between_columns) / n",
          "agreement::test_icc_of_the_published_example"),
    Fault("leaderboard/metrics/agreement.py", ".max() / max(power))", ".max() / np.sqrt(power[0] * power[1]))",
          "agreement::test_the_correlation_of_a_scaled_profile_is_the_smaller_ratio"),
    Fault("leaderboard/drive_report/obstacles.py", "GUMBEL_SCALE = 3.72,", "GUMBEL_SCALE = 2.72,",
          "drive_report::test_random_roads_have_next_to_no_obstacles"),
    Fault("leaderboard/drive_report/obstacles.py", "first, last = max(0, begin - reach)", "first, last = max(0, begin)",
          "drive_report::test_heights_of_obstacles_are_read_over_the_line_between_their_feet"),
    Fault("leaderboard/drive_report/obstacles.py", "self.height / gain", "self.height * gain",
          "drive_report::test_a_half_sine_is_corrected_for_its_mean_about_the_crest"),
    Fault("estimators/wiener/drive_check.py", "a[:, near] = np.nan", "a[:, near] += 0.0",
          "drive_check::test_samples_about_obstacles_are_left_out_unless_most_are"),
    Fault("leaderboard/drive_report/posterior_iri.py", "MAX_ERROR_SHARE * _roughness", "9.0 * _roughness",
          "drive_report::test_an_error_larger_than_the_road_counts_for_a_third_of_its_roughness"),
    Fault("road_envs/analysis/alignment.py", "return k[use] + start, r", "return k[use], r",
          "alignment::test_the_lag_and_the_heights_of_the_overlap_are_found"),
    Fault("road_envs/analysis/alignment.py", "CHANCE / np.sqrt(independent)", "0.0",
          "alignment::test_another_road_matches_nowhere"),
    Fault("road_envs/data/logger_tables/motion.py", "usual = max(1, int(np.median(lengths)))", "usual = x.size",
          "logger_tables::test_a_constant_speed_between_changes_is_no_ramp"),
    Fault("leaderboard/conformance/checks.py", "passed=None if refused else False", "passed=None",
          "conformance_checks::test_a_deliberate_refusal_is_accepted_and_an_unintended_error_fails"),
    Fault("leaderboard/conformance/checks.py", "passed=not error > MAX_ERROR", "passed=True",
          "conformance_checks::test_heights_in_millimetres_are_refused_with_a_hint"),
    Fault("leaderboard/conformance/checks.py", "found[1] not in UNINTENDED_ERRORS", "found[1]",
          "conformance_checks::test_a_deliberate_refusal_is_accepted_and_an_unintended_error_fails"),
    Fault("leaderboard/conformance/checks.py", "training_run.estimate_seconds * test_length / metres", "training_run.estimate_seconds",
          "conformance_checks::test_the_run_time_is_predicted_for_a_whole_condition_of_the_board"),
    Fault("leaderboard/conformance/probes.py", "np.nanstd(record.a)", "np.std(record.a)",
          "conformance_checks::test_a_record_with_lost_samples_can_be_perturbed"),
    Fault("estimators/api.py", 'hasattr(cls, "fit") and missing', "False",
          "conformance_checks::test_an_estimator_that_cannot_be_constructed_fails_only_the_contract"),
    Fault("leaderboard/conformance/results.py", "package_version(), _checks_version(), estimator", "package_version(), estimator",
          "conformance_results::test_a_card_is_valid_only_for_its_code_settings_and_probe_version"),
    Fault("leaderboard/running/board.py", "if result.code != entry.code:", "if False:",
          "conformance_results::test_a_row_of_other_code_weights_or_settings_is_stale"),
    Fault("leaderboard/evaluation/entries.py", "return pretrained_weights.load_pretrained(estimator.name)", "return {}",
          "conformance_results::test_a_row_is_stale_after_a_change_of_shipped_weights"),
    Fault("leaderboard/evaluation/entries.py", '{**entry.settings, "shipped": False}', "entry.settings",
          "conformance_results::test_on_tasks_trained_per_case_a_quickly_fitted_estimator_drops_its_weights"),
    Fault("leaderboard/report/cache.py", "store.row_checksum(result),", "",
          "site_pages::test_an_unchanged_site_is_not_rewritten_and_any_change_rebuilds_it"),
    Fault("leaderboard/report/site.py", "if report.pages and all(", "if report.pages or all(",
          "site_pages::test_an_unchanged_site_is_not_rewritten_and_any_change_rebuilds_it"),
    Fault("leaderboard/report/figures.py", "prepend=0", "append=0",
          "site_charts::test_encoded_heights_are_decoded_to_the_stored_ones"),
    Fault("leaderboard/report/estimator_page.py", "norm.ppf(0.5 + share / 2.0)", "norm.ppf(share)",
          "site_charts::test_calibration_counts_the_errors_inside_the_stated_intervals"),
    Fault("road_envs/rendering/side.py", "self._draw_stones() if self.paved", "self._draw_stones() if True",
          "rendering::test_only_belgian_paving_is_drawn_with_stones"),
    Fault("leaderboard/paper/study.py", 'replace(condition, grade="S0")', "condition",
          "paper::test_the_test_road_is_also_driven_by_the_car_of_the_training"),
    Fault("leaderboard/paper/published_figures.py", "if lost > 0.1", "if lost > -1.0",
          "paper::test_the_reasons_follow_the_numbers"),
    Fault("road_envs/_atomic_io.py", "or not _try_lock(owner)", "",
          "atomic_io::test_temporary_folders_of_dead_owners_are_removed"),
    Fault("road_envs/_numba.py", "global_compiler_lock, exclusive_lock(lock, MAX_WAIT)", "global_compiler_lock",
          "code_digest::test_processes_that_start_together_compile_a_kernel_once"),
    Fault("road_envs/_reading.py", "> MAX_COMPRESSION * len(data)", "> math.inf",
          "hostile_files::test_a_bomb_is_refused_before_it_is_unpacked"),
    Fault("road_envs/_reading.py", "if cells > MAX_CELLS", "if cells > math.inf",
          "hostile_files::test_a_parquet_file_of_a_constant_is_refused_before_it_is_unpacked"),
    Fault("road_envs/data/logger_tables/table.py", "np.abs(x) > LARGEST / factor", "np.abs(x) > np.inf",
          "hostile_files::test_any_cell_of_a_drive_is_read_or_refused"),
    Fault("road_envs/_reading.py", "except Exception as failure:", "except ValueError as failure:",
          "hostile_files::test_archives_that_lie_about_their_arrays_are_refused"),
    Fault("road_envs/config.py", "pickle.loads(_parse(path.read_text(encoding=\"utf-8\"), shipped))",
          "(_parse.__dict__.setdefault(path, yaml.load(path.read_text(), Loader=_Loader)))",
          "config::test_what_a_caller_changes_in_a_file_that_was_read_changes_nothing_for_the_next"),
    Fault("road_envs/config.py", "known[id(node)] = 1 + sum(", "known[id(node)] = 0 * sum(",
          "hostile_files::test_aliases_count_as_what_they_stand_for"),
    Fault("road_envs/vehicle/body_bending.py", "/ (0.25 * car.m_b)", "/ (0.5 * car.m_b)",
          "body_bending::test_a_sine_is_answered_by_the_closed_form"),
    Fault("estimators/common/bending.py", "backward = (self.shape @ means)[::-1]", "backward = self.shape @ means",
          "sensed_bending::test_tangent_and_adjoint_are_transposes_and_the_tangent_a_derivative"),
    Fault("leaderboard/evaluation/entry.py", "session.calibrate(calibrations[k])", "session.calibrate(calibrations[0])",
          "sandbox::test_each_estimate_follows_the_calibration_to_its_own_vehicle"),
    Fault("leaderboard/evaluation/tasks.py", "            used |= seeds\n", "",
          "tasks::test_an_invalid_calibration_drive_is_refused"),
    Fault("estimators/common/identified_vehicle.py", "s=record.s + self.displacement", "s=record.s - self.displacement",
          "identified_vehicle::test_every_estimator_with_a_model_uses_what_was_identified"),
]  # fmt: skip


def test_id(tree: Path, tests: str) -> str:
    """The identifier by which pytest knows `tests`, "file::name"."""
    file, name = tests.split("::")
    (path,) = (tree / "tests").glob(f"*/test_{file}.py")
    return f"{path}::{name}"


def run_tests(tree: Path, *tests: str) -> tuple[int, str]:
    """Exit status and output of pytest in a tree."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    command += ["--hypothesis-profile", "faults"]  # a red test need not look for its least example
    settings = {"XDG_CACHE_HOME": str(tree / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [*command, f"--basetemp={tree / 'tmp'}", *(test_id(tree, name) for name in tests)],
        cwd=tree,
        env=os.environ | settings,
        capture_output=True,
        text=True,
    )
    return done.returncode, done.stdout + done.stderr


def verdict(tree: Path, fault: Fault) -> str:
    """The word "caught", or what went wrong."""
    path = tree / fault.file
    text = path.read_text(encoding="utf-8")
    if text.count(fault.old) != 1:
        return f"DOES NOT FIT: found {text.count(fault.old)} times"
    path.write_text(text.replace(fault.old, fault.new), encoding="utf-8")
    try:
        status, output = run_tests(tree, fault.tests)
    finally:
        path.write_text(text, encoding="utf-8")
    if status == 0:
        return "SURVIVED"
    return "caught" if status == 1 else f"BROKE THE RUN (status {status})\n{output[-800:]}"


def copy_tree(tree: Path) -> Path:
    """Copy what the tests need to a new folder."""
    tree.mkdir()
    for name in COPIED:
        if (ROOT / name).is_dir():
            ignore = shutil.ignore_patterns("__pycache__")
            shutil.copytree(ROOT / name, tree / name, ignore=ignore)
        else:
            shutil.copy(ROOT / name, tree / name)
    return tree


def main(wanted: str) -> int:
    chosen = [f for f in FAULTS if wanted in f.file or wanted in f.old or wanted in f.new]
    jobs = int(os.environ.get("MUTANT_JOBS", os.cpu_count() or 1))
    caught = 0
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(jobs) as pool:
        trees = [copy_tree(Path(folder) / str(job)) for job in range(jobs)]
        status, output = run_tests(trees[0], *sorted({f.tests for f in chosen}))
        if status != 0:
            print(f"without any fault the tests are not green:\n{output[-4000:]}")
            return 1
        for tree in trees[1:]:  # kernels compiled without a fault serve all trees
            shutil.copytree(trees[0] / "cache", tree / "cache")
        idle: SimpleQueue[Path] = SimpleQueue()
        for tree in trees:
            idle.put(tree)

        def attempt(fault: Fault) -> tuple[Fault, str, float]:
            tree, start = idle.get(), time.perf_counter()
            try:
                return fault, verdict(tree, fault), time.perf_counter() - start
            finally:
                idle.put(tree)

        for fault, found, spent in pool.map(attempt, chosen):
            caught += found == "caught"
            print(f"{found:8} {spent:4.0f} s  {fault.file}: {fault.old} -> {fault.new}", flush=True)
    print(f"{caught} of {len(chosen)} faults caught")
    return 0 if caught == len(chosen) > 0 else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1] if len(sys.argv) > 1 else ""))
