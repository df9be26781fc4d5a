"""What is shown in the machines: each check is a function of the service that returns its figure."""

from __future__ import annotations

from collections.abc import Callable

from tests.vm.checks import faults, links, people, sessions, upgrade
from tests.vm.service import Service

Check = Callable[[Service], str]

# Each row, in its order, is shown in a machine of its own; that they take about as long is what two processors are for.
ROWS: tuple[tuple[Check, ...], ...] = (
    (
        people.the_service_starts,
        sessions.a_session_ends_in_an_accepted_model,
        upgrade.an_upgrade_keeps_the_data,
        links.the_listening_card_has_sent_nothing,
    ),
    (
        people.the_service_starts,
        links.all_that_is_sent_on_vcan_is_stored,
        links.a_bus_off_alarms_and_ends,
        links.a_deleted_interface_comes_back,
        faults.a_full_disk_is_told_and_nothing_is_lost,
        links.all_that_is_sent_between_cards_is_stored,
        people.operators_lookers_and_others_have_their_rights,
        people.what_reads_its_configuration_finds_the_service,
        links.an_adapter_is_known_by_its_serial_number,
        links.an_interface_that_went_down_is_read_again,
        links.a_card_that_was_pulled_is_read_again,
        faults.a_clock_that_was_set_is_noticed,
        faults.a_suspended_computer_goes_on,
        faults.two_spinning_processes_cost_no_frame,
        faults.a_process_that_was_held_up_catches_up,
        faults.a_hung_service_is_restarted_by_its_watchdog,
        faults.a_killed_service_is_restarted,
        people.the_journal_has_priorities,
        links.the_listening_card_has_sent_nothing,
    ),
)
