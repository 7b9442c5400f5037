"""Connections and processes that come and go, leases that end without their holder's word, and a
journal that fails.

Leases belong to processes: a connection that drops loses nothing that is resident (its process
reattaches or the time to live runs out); `bye` gives everything back; death ends everything. The
bytes of a lease that expired or was lost are measured gone before they are granted again.
"""

from collections.abc import Iterable
from dataclasses import replace

from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core import standby
from vram_arbiter.arbiter.core.learning import model_name
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import EXPIRING, Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Client, Core
from vram_arbiter.arbiter.core.requests.requests import cancel_waiter, released
from vram_arbiter.arbiter.core.requests.uses import end_use
from vram_arbiter.arbiter.core.verification.schedule import begin_for_lease, on_process_died
from vram_arbiter.schemas.ids import ClientId, LeaseId
from vram_arbiter.schemas.wire.codes import Order, Why
from vram_arbiter.schemas.wire.notes import DeniedNote, ExpiredNote, JournalFailedNote, LostNote
from vram_arbiter.schemas.wire.pushes import DeniedPush, LostPush


def on_connected(core: Core, event: ev.ClientConnected) -> None:
    """Admit a client. The same instance on a new connection is the same client: its leases, waits
    and uses are the new connection's, and only the newest connection is remembered."""
    if event.client in core.clients:
        core.part(event.client)
    siblings = core.connected.get(event.process, {}).values()
    same = (client.id for client in siblings if client.instance == event.instance)
    if (earlier := next(same, None)) is not None:
        core.part(earlier)
        for lease in core.used_by(event.process):
            for key, use in lease.uses.items():
                if use.client == earlier:
                    lease.uses[key] = replace(use, client=event.client)
        for lease in list(core.of_client.get(earlier, {}).values()):
            core.hand_to(lease, event.client)
    core.join(Client(event.client, event.process, event.name, event.instance, event.uid))
    core.last_client_at = core.now
    for gpu in core.gpus.values():
        gpu.touched = True
        if gpu.sample is None or core.now - gpu.sample.taken_at > core.settings.sample_max_age_s:
            gpu.want_sample(core.now, core.now - core.settings.sample_max_age_s)


def on_left(core: Core, event: ev.ClientLeft) -> None:
    """End the queued leases and the uses of a connection. Its resident leases end with a `bye`
    only."""
    client = core.clients.get(event.client)
    if client is None:
        return
    core.part(client.id)
    core.last_client_at = core.now
    own = core.of_client.get(client.id, {}).values()
    for lease in _by_arrival(own, core.used_by(client.process)):
        for use in [use for use in lease.uses.values() if use.client == client.id]:
            end_use(core, lease, use, Why.CLIENT_LEFT, event.reason)
        if lease.client != client.id or lease.process != client.process:
            continue
        if lease.state is LeaseState.QUEUED:
            cancel_waiter(core, lease, Why.CLIENT_LEFT, event.reason)
        elif lease.state not in EXPIRING:
            refusal = no.CancelledRequest(lease.id, Why.CLIENT_LEFT, event.reason)
            standby.give_up(core, lease, LeaseState.CANCELLED, refusal)
        elif event.reason == ev.BYE:
            released(core, lease, exiting=False, why=Why.BYE)


def _by_arrival(own: Iterable[Lease], used: Iterable[Lease]) -> list[Lease]:
    found = {lease.id: lease for lease in (*own, *used)}
    return sorted(found.values(), key=lambda lease: lease.request.arrival)


def concerns(core: Core, client: ClientId) -> bool:
    """Return whether a live lease, a request or a use is this client's: losing its connection ends
    nothing otherwise."""
    if client in core.of_client:
        return True
    known = core.clients.get(client)
    used = [] if known is None else core.used_by(known.process)
    return any(use.client == client for lease in used for use in lease.uses.values())


def on_died(core: Core, event: ev.ProcessDied) -> None:
    """End everything of a process. Its bytes become debts, measured gone before they count as
    free."""
    process = event.process
    core.refusals.pop(process, None)
    core.terminated.discard(process)
    for client in list(core.connected.get(process, ())):
        core.part(client)
        core.last_client_at = core.now
    for gpu in core.gpus.values():
        if process in gpu.ledger.accounts:
            on_process_died(gpu, process, core.now, core.settings)
    for lease in _by_arrival(core.leases_of(process), core.used_by(process)):
        for use in [use for use in lease.uses.values() if use.process == process]:
            end_use(core, lease, use, Why.PROCESS_DIED)
        if lease.process != process:
            continue
        core.account_for(lease.id)
        refusal = no.Lost(lease.id, Why.PROCESS_DIED, process.pid)
        if lease.state is LeaseState.QUEUED:
            cancel_waiter(core, lease, Why.PROCESS_DIED)
        elif lease.state in EXPIRING:
            core.note(LostNote(Why.PROCESS_DIED, process.pid), lease)
            lose(core, lease, refusal)
        else:  # a verification goes on: only the residue is no longer expected
            standby.give_up(core, lease, LeaseState.LOST, refusal)


# -- ends without the holder's word
def expire(core: Core, lease_id: str, order: Order | None = None) -> None:
    """End a lease that its holder did not renew, or that an operator gives up before its time.

    The holder may still be loading until it fences itself, so there is no verdict before that. One
    that is loaded has to be measured gone (if that can be seen), or to have fenced itself.
    """
    lease = core.leases[LeaseId(lease_id)]
    why = Why.NOT_RENEWED if order is None else Why.GIVEN_UP
    refusal = no.Expired(lease.id, lease.spec.ttl_s, why, order)
    core.note(ExpiredNote(why, lease.spec.ttl_s), lease)
    assert lease.token is not None, f"{lease.id} expires without a token"
    core.push(lease, LostPush(lease.id, lease.token, refusal.view()))
    # after a restart the deadline has the grace in it
    grace_s = core.settings.fence_grace_s if lease.attached else 0.0
    fenced_at = lease.expires_at + grace_s
    weight_bytes = _most_held_bytes(core.gpu_of(lease), lease) - lease.spec.footprint.residue_bytes
    # too few bytes for a reading to tell
    tiny = weight_bytes <= 2 * core.settings.verify_tolerance_bytes
    if lease.state is LeaseState.LOADING or tiny:
        grace_s = max(0.0, fenced_at - core.now)
    # its bytes stay charged: a request that fits beside them need not wait for the verdict
    core.recovering.discard(lease.id)
    lose(core, lease, refusal, grace_s, fenced_at)


def _most_held_bytes(gpu: Gpu, lease: Lease) -> int:
    """Return the most that a lease may hold: its charge, or less where the newest reading shows
    less. A lease that never filled its charge has nothing that a reading could see leave."""
    charge_bytes = gpu.ledger.charge_bytes(lease.id)
    if gpu.sample is None:
        return charge_bytes
    return min(charge_bytes, gpu.shown_bytes(lease.process) or gpu.sample.used_bytes)


def lose(
    core: Core,
    lease: Lease,
    refusal: no.Expired | no.Lost,
    grace_s: float = 0.0,
    fenced_at: float = 0.0,
) -> None:
    """End a resident lease: expired while its process lives, or lost with it.

    Its bytes become a debt and are measured away. A holder that lives may still be loading for
    `grace_s`, and fences itself at `fenced_at`.
    """
    alive = isinstance(refusal, no.Expired)
    gpu, asked = core.gpu_of(lease), lease.departure.eviction
    if lease.state is LeaseState.LOADING:
        core.costs.load_failed(model_name(lease.spec), refusal.why, core.now)
    for use in list(lease.uses.values()):
        core.unmark(lease, use)
    core.record_lease(lease, debt=True)
    if asked is not None:
        asked.released_at = core.now
        asked.unloading_at = asked.unloading_at or core.now
    begin_for_lease(core, gpu, lease, alive=alive, grace_s=grace_s, fenced_at=fenced_at)
    core.move(lease, LeaseState.EXPIRED if alive else LeaseState.LOST, refusal.why)
    core.end(lease, refusal)


# -- the journal
def on_journal_failed(core: Core, event: ev.JournalFailed) -> None:
    """A grant that could not be written was not sent: it is taken back. The executor refuses the
    request whose reply it held back; a waiter that was to hear by push is denied here.

    Other records only make a later recovery more careful; they are worth a note.
    """
    core.note(JournalFailedNote(event.key, event.reason))
    lease = core.leases.get(LeaseId(event.key.removeprefix("lease:")))
    if not event.gates or lease is None or lease.state is not LeaseState.LOADING:
        return
    gpu = core.gpu_of(lease)
    gpu.ledger.withdraw(lease.id, core.now)
    core.forget(event.key)
    refusal = no.NotJournaled(lease.id, event.key, event.reason)
    core.move(lease, LeaseState.DENIED, refusal.code)
    if lease.request.id is None:  # else: the session that held the reply back refused it
        core.push(lease, DeniedPush(lease.id, refusal.view()))
    core.note(DeniedNote(refusal), lease)
    core.end(lease, refusal)
