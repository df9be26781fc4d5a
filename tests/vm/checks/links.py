"""The bus and the station's line: what is sent is stored, and what goes away comes back."""

from __future__ import annotations

from tests.vm.service import BUS, STATION, Service, expect

RECOVERY_S = 2.0
TRAFFIC_S = 20
BUS_OFF = "20000040#0000000000000000"  # an error frame of CAN_ERR_BUSOFF


def recovered(service: Service, since_s: float, link: str = BUS) -> str:
    """Expect a link's captures to go on in time after the end of what was wrong."""
    after_s = service.first_capture_s(since_s, link) - since_s
    expect(after_s <= RECOVERY_S, f"{link}: the first capture came {after_s:.2f} s after the end of the fault")
    return f"read again after {after_s:.2f} s"


def all_sent_is_stored(service: Service, wiring: str, heard: str) -> str:
    """Send for a while, stop, and compare what the kernel has counted with what the store has more."""
    service.on(wiring)
    before, counted = service.pause_rig(), service.counted(heard)
    service.resume_rig()
    service.machine.run(f"sleep {TRAFFIC_S}")
    stored, sent = service.pause_rig() - before, service.counted(heard) - counted
    service.resume_rig()
    expect(stored == sent > 500, f"{sent} frames came in, {stored} are stored")
    return f"{stored} of {sent} frames stored"


def all_that_is_sent_on_vcan_is_stored(service: Service) -> str:
    """Every frame that the rig sends on a virtual bus is in the store."""
    return all_sent_is_stored(service, "vcan", "vcan0")


def all_that_is_sent_between_cards_is_stored(service: Service) -> str:
    """Every frame that one card sends and the other, which only listens, hears is in the store."""
    service.on("cards")
    link = service.machine.run("ip -details link show can0")
    expect("listen-only on" in link.lower() or "LISTEN-ONLY" in link, link)
    return all_sent_is_stored(service, "cards", "can0")


def a_bus_off_alarms_and_ends(service: Service) -> str:
    """The error frame of a bus-off is an alarm that says what to do, and ends when the bus is heard."""
    service.on("vcan")
    service.pause_rig()
    service.machine.run(f"cansend vcan0 {BUS_OFF}")
    alarm = service.wait_for_alarm("bus_off")
    expect("termination" in alarm["remedy"], alarm)
    service.resume_rig()
    service.wait_for_alarm("bus_off", stands=False)
    service.wait_until_well()
    return f"alarm: {alarm['text'][:60]}"


def a_deleted_interface_comes_back(service: Service) -> str:
    """An interface that is deleted is an alarm; made again, it is read again."""
    service.on("vcan")
    service.machine.run("ip link del vcan0")
    alarm = service.wait_for_alarm("link_down")
    expect(alarm["subject"] == BUS and alarm["remedy"], alarm)
    service.machine.run("ip link add dev vcan0 type vcan && ip link set vcan0 up")
    up_s = service.machine.now_s()
    # The simulator opens its end again by itself, once a second.
    figure = _open_again(service, up_s)
    service.wait_for_alarm("link_down", stands=False)
    service.wait_until_well()
    return figure


def an_interface_that_went_down_is_read_again(service: Service) -> str:
    """An interface that goes down is an alarm; up again, it is read again."""
    service.on("cards")
    service.machine.run("ip link set can0 down")
    service.wait_for_alarm("link_down")
    figure = recovered(service, service.machine.tried("ip link set can0 up").ended_s)
    service.wait_for_alarm("link_down", stands=False)
    return figure


def a_card_that_was_pulled_is_read_again(service: Service) -> str:
    """A card that vanishes is an alarm; when it is back, networkd sets it up and it is read again."""
    service.on("cards")
    driver = "/sys/bus/pci/drivers/kvaser_pci"
    the_listening_card_has_sent_nothing(service)  # its counters go with it
    address = service.machine.run("basename $(readlink -e /sys/class/net/can0/device)").strip()
    service.machine.run(f"echo {address} > {driver}/unbind")
    service.wait_for_alarm("link_down")
    service.machine.run(f"echo {address} > {driver}/bind")
    look = "ip link show can0 up | grep can0"
    service.wait("networkd to set can0 up", lambda: service.machine.tried(look).status == 0)
    figure = recovered(service, service.machine.now_s())
    service.wait_for_alarm("link_down", stands=False)
    return figure


def an_adapter_is_known_by_its_serial_number(service: Service) -> str:
    """The station's adapter is pulled out; another one does not take its place; put back, it is read again."""
    service.on("cards")
    service.machine.unplug_adapter()
    alarm = service.wait_for_alarm("link_down")
    expect(alarm["subject"] == STATION and alarm["remedy"], alarm)
    service.machine.plug_adapter("OTHER-1")
    service.wait("the other adapter", lambda: service.machine.tried("ls /dev/ttyUSB*").status == 0)
    service.machine.run("udevadm settle")
    expect(service.machine.tried("readlink -e /dev/rigcal-station").status, "another adapter has the station's name")
    service.machine.unplug_adapter()
    service.wait("the other adapter to go", lambda: service.machine.tried("ls /dev/ttyUSB*").status != 0)
    service.machine.plug_adapter()
    service.wait("its name", lambda: service.machine.tried("readlink -e /dev/rigcal-station").status == 0)
    figure = recovered(service, service.machine.now_s(), STATION)
    service.wait_for_alarm("link_down", stands=False)
    service.wait_until_well()
    return figure


def the_listening_card_has_sent_nothing(service: Service) -> str:
    """After all of it the card that listens has sent no frame."""
    sent = service.counted("can0", "tx_packets")
    expect(sent == 0, f"can0 has sent {sent} frames")
    return f"0 frames sent, {service.counted('can0')} heard"


def _open_again(service: Service, since_s: float) -> str:
    """Expect a link to be open in time; the rig at its other end takes a while of its own."""
    service.wait("the link", lambda: service.link()["up"])
    status = service.ask("status")
    link = next(one for one in status["acquisition"]["links"] if one["name"] == BUS)
    after_s = service.machine.now_s() - since_s - link["since_s"]
    expect(after_s <= RECOVERY_S, f"the link was opened {after_s:.2f} s after the interface was there")
    return f"open again after {max(after_s, 0.0):.2f} s"
