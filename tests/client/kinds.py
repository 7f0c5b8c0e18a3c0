"""The client's tests that hold for every kind of camera: nearly all that speak to one.

They run at the wire, over a fleet's bus inside the process, and in the long run over Zenoh, too.
What holds at the wire only stands in a table with its reason; ``docs/sharing-a-camera.md`` says
what users have to know of that.
"""

from __future__ import annotations

MODULES = frozenset(
    {
        "test_16_bit",
        "test_bid",
        "test_calibration",
        "test_cancel",
        "test_insight",
        "test_known_failures",
        "test_numbers",
        "test_outcomes",
        "test_reconnect",
        "test_requests",
        "test_restore",
        "test_session",
        "test_subscribers",
        "test_switch",
        "test_taken",
        "test_trigger",
        "test_udp",
    }
)
"""Modules whose tests hold for every kind."""

AT_THE_WIRE: dict[str, tuple[str, ...]] = {
    "it looks inside the client, or counts the steps of the event loop": (
        "test_answer_of_another_kind_than_asked_for_is_an_error",
        "test_bid_request_gives_the_answers_body",
        "test_bid_status_is_asked_for_only_while_somebody_wants_it",
        "test_bid_status_from_before_a_request_is_no_answer_to_it",
        "test_close_while_a_command_of_before_still_has_the_turn_is_immediate",
        "test_debt_is_of_all_results_that_are_missing",
        "test_dialect_found_out_once_is_kept",
        "test_settling_cancelled_at_any_step_leaves_the_next_trigger_its_own_result",
        "test_next_result_cancelled_in_the_same_step_takes_nothing",
        "test_only_what_another_client_can_have_caused_is_taken_for_it",
        "test_next_session_waits_for_a_command_of_before_not_for_ever",
        "test_observers_are_told_the_loss_and_every_failed_try",
        "test_old_link_is_over_before_the_camera_hears_the_next_connect",
        "test_own_number_that_does_not_fit_leaves_no_debt",
        "test_result_at_the_very_deadline_is_returned",
        "test_result_that_comes_before_its_caller_is_cancelled_owes_nothing",
        "test_result_that_comes_while_its_caller_is_being_cancelled_is_late",
        "test_results_per_trigger_that_lack_one_say_how_many_came",
        "test_supervisor_that_fails_tells_everybody",
        "test_trigger_that_goes_out_at_once_has_nothing_to_wait_for",
        "test_input_of_a_trigger_without_result_is_never_taken_for_the_next",
        "test_results_of_a_lost_link_give_what_was_queued_first",
        "test_trigger_is_never_sent_again_by_itself",
    ),
    "it counts what only who has the session sees: frames, lost triggers, unwanted results": (
        "test_accounts_balance_whatever_happens",
        "test_answer_over_udp_that_comes_twice_is_used_once",
        "test_answer_that_nobody_asked_for_is_counted_only",
        "test_answer_to_connect_over_udp_that_comes_twice_is_counted_only",
        "test_bid_late_result_after_a_timeout_is_never_the_next_triggers",
        "test_bid_late_result_is_never_the_next_triggers",
        "test_bid_trigger_error_during_ours_is_an_overtrigger",
        "test_everything_is_counted_over_all_sessions",
        "test_extra_results_of_the_emulator_are_counted",
        "test_garbage_over_udp_is_ignored_and_counted",
        "test_late_result_is_never_taken_for_the_next_one",
        "test_late_result_within_the_grace_needs_no_stop",
        "test_next_result_is_registered_when_it_is_called",
        "test_next_result_never_awaited_wants_nothing_any_more",
        "test_next_result_times_out_with_what_the_status_is",
        "test_numbers_of_the_emulator_keep_sensors_and_triggers_apart",
        "test_overtriggered_bit_that_was_set_before_is_not_ours",
        "test_owed_number_does_not_hide_the_debt_of_a_trigger_without_one",
        "test_request_of_an_unknown_id_gives_the_answer_under_the_same_id",
        "test_result_that_nobody_wants_is_counted_and_not_interpreted",
        "test_results_left_by_their_reader_are_no_subscription_any_more",
        "test_results_per_trigger_with_one_that_does_not_fit_raises",
        "test_second_result_of_a_trigger_is_extra_and_never_the_next_ones",
        "test_second_result_with_a_number_is_extra_even_behind_the_next_trigger",
        "test_statistics_count_what_went_over_the_wire",
        "test_statistics_stay_during_an_outage_and_after_the_end",
        "test_trigger_after_another_applications_result_never_gets_the_late_one",
        "test_trigger_between_waiting_and_its_drop_takes_no_older_result",
        "test_trigger_cancelled_owes_a_result_that_the_next_one_never_gets",
        "test_trigger_of_the_emulators_free_running_application_says_so",
        "test_trigger_over_udp_cancelled_owes_a_result",
        "test_trigger_overtriggered_raises_and_the_result_is_streamed",
    ),
    "it looks at the camera's own address, its name there, or each attempt to reach it": (
        "test_application_reported_by_the_emulator_is_known_at_once",
        "test_attempts_that_are_used_up_tell_the_loss_and_the_last_failure",
        "test_bid_query_busy_for_ever_fails_the_connect_in_time",
        "test_bid_refused_session_tells_the_code",
        "test_bid_switch_refused_tells_the_code_and_what_is_active",
        "test_bid_trigger_refused_as_busy_is_an_error_where_it_shall_not_wait",
        "test_camera_before_open_knows_nothing",
        "test_connect_knows_the_camera",
        "test_connect_logs_in_with_user_and_password",
        "test_connect_with_a_wrong_password_is_tried_once_and_shows_none",
        "test_counter_is_one_cell",
        "test_dialect_not_named_is_found_out_and_pinned",
        "test_dialect_over_udp_is_found_out",
        "test_events_of_a_loss_come_in_order",
        "test_events_of_a_session_come_in_order",
        "test_open_where_nothing_listens_fails_with_every_attempt",
        "test_open_without_an_answer_fails_and_says_silence",
        "test_session_is_made_again_as_the_first_was_with_the_dialect_pinned",
        "test_session_over_udp_does_everything",
        "test_session_that_cannot_begin_by_a_fault_of_ours_tells_the_opener",
        "test_url_has_the_telnet_port_by_default",
    ),
    "an error is the very object that it was": (
        "test_get_clock_never_answered_gives_the_link_up",
        "test_loss_tells_everybody_the_same_first_cause",
        "test_switch_never_answered_gives_the_link_up",
    ),
    "an agent gives no camera up that was taken: tests/fleet/test_taken.py": (
        "test_camera_taken_over_udp_is_not_fought_for_where_silence_shows_it_late",
        "test_camera_that_another_client_took_is_not_fought_for",
        "test_outcome_of_a_wait_after_it_was_taken",
        "test_session_lost_again_after_our_own_reboot_was_not_taken",
        "test_session_lost_again_soon_after_a_reconnect_was_taken",
    ),
    "frames do not cross": (
        "test_bid_session_byte_for_byte",
        "test_trigger_is_traced",
    ),
    "what the agent knows of results is not known before it has answered": (
        "test_calibration_with_values_that_never_are_localizations_is_refused[None]",
    ),
    "a result of another application is somebody else's to take": (
        "test_outcome_of_a_trigger_by_hand[result of another application than was active]",
    ),
    "the next status comes in a datagram of its own, a moment later": (
        "test_bid_trigger_error_during_ours_is_an_overtrigger_and_then_reset[udp-push]",
    ),
}
"""By reason, those that do not: names of tests, or with a parameter in brackets one of theirs."""

OVER_TCP_ON_A_BUS = frozenset({"test_call_cancelled_at_any_step_leaves_a_camera_that_works"})
"""Dear sweeps whose bus leads to a camera over TCP; over UDP the same ones run at the wire."""

IN_TIME_OF_THEIR_OWN = frozenset(
    {
        "test_settling_that_was_cancelled_after_its_stop_is_finished_by_the_next",
        "test_switch_cancelled_in_any_phase_leaves_a_camera_that_works",
        "test_request_cancelled_in_line_sends_nothing",
        "test_trigger_whose_turn_comes_too_late_is_not_sent",
        "test_close_while_opening_ends_the_opener",
        "test_events_tell_of_changes_that_are_asked_for",
        "test_connection_lost_again_soon_is_no_other_clients_doing",
        "test_camera_that_takes_no_bytes_is_a_timeout",
        "test_reconnect_keeps_the_password",
        "test_cancelled_after_any_step_the_camera_goes_on",
        "test_wait_connected_waits_for_what_is_restored",
        "test_body_of_5_mb_in_segments_is_copied_once",
        "test_image_sized_answer_pays_no_idle_wait",
        "test_application_closed_inside_goes_nowhere",
        "test_results_that_nobody_takes_hold_no_more_bytes_than_the_default",
        "test_call_cancelled_at_any_step_and_repeated_is_done",
        "test_call_cancelled_at_any_step_leaves_a_camera_that_works",
        "test_call_cancelled_at_any_step_leaves_a_camera_whose_state_is_known",
        "test_close_at_any_step_of_a_trigger_in_another_application_ends_it",
        "test_close_cancelled_at_any_step_leaves_nothing",
        "test_settling_cancelled_at_any_step_leaves_the_next_trigger_its_own_result",
        "test_open_cancelled_at_any_step_leaves_a_camera_for_the_next",
        "test_trigger_cancelled_at_any_step_leaves_the_next_trigger_its_own_result",
    }
)
"""Tests that count the loop's steps, measure, name exact times, or take long in real time.

They run neither over Zenoh nor in uvloop, whose time is the real one.
"""
