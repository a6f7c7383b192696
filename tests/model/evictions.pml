/* Models a Redis that removes a session while servers take it from each other (docs/fleet.md): which copies there are.
 *
 * Two servers; a client without affinity asks either at any time. A server whose copy is behind the request gives it up
 * and claims the session. Redis removes the session at any time, both keys at once. No server dies.
 *
 * Checked, by assertions:
 * - there is always a copy of the session: in Redis, of a server, or one that a server has given up and kept;
 * - what an owner acknowledges is in Redis then.
 *
 * Each of these is the old protocol, or lacks a part, so that the check must fail:
 * -DGIVE_UP    a server drops the copy that it has given up, also if Redis has nothing
 * -DNO_FENCE   an owner that another one has replaced goes on
 *
 * run_model.py runs SPIN on this file. Behind each transition stands the function that implements it. */

#define DECISIONS 3
#define MOST_CLAIMS 4
#define MOST_EVICTIONS 3
#define NONE 99

/* Redis: the hash, and what its journal makes of the session. */
bool stored = true;
byte stored_epoch = 1;
byte stored_decisions = 0;

/* Of each server: SessionEntry, SessionJournal, FormerCopies. */
byte copy[2] = NONE;          /* decisions of it */
byte epoch[2];
byte claimed_from[2];
byte former[2] = NONE;        /* given up, and kept */

byte acknowledged = 0;        /* decisions whose answers the client has */
byte next_epoch = 2;          /* a claim adds a random number: no two have the same epoch */
byte evictions = 0;

inline check_copies() {
  assert(stored || copy[0] != NONE || copy[1] != NONE || former[0] != NONE || former[1] != NONE)
}

/* RedisBackend::WriteAll(), FindReason(), JournalStore::WriteAgain(): an entry, or the whole session again. */
inline write(s) {
  if
  :: !stored || stored_epoch == epoch[s] || (stored_epoch < epoch[s] && stored_epoch == claimed_from[s]) ->
    stored = true; stored_epoch = epoch[s]; stored_decisions = copy[s];
    acknowledged = (copy[s] > acknowledged -> copy[s] : acknowledged);
    assert(stored_decisions == copy[s])
  :: else ->
#ifdef NO_FENCE
    acknowledged = (copy[s] > acknowledged -> copy[s] : acknowledged);
    assert(stored_decisions == copy[s])
#else
    copy[s] = NONE  /* SessionJournal::OnWritten(): the copy is lost */
#endif
  fi;
  check_copies()
}

/* SessionRecovery::Recover(), Restore(), RedisBackend::RunClaims(). */
inline claim(s) {
  if
  :: stored && next_epoch < MOST_CLAIMS + 2 ->
    claimed_from[s] = stored_epoch; epoch[s] = next_epoch; stored_epoch = next_epoch; next_epoch++;
    copy[s] = stored_decisions; former[s] = NONE
  :: else
  fi;
  check_copies()
}

proctype Server(bit s) {
  do
  /* DecideActs(): the next decision, or one that is sent again to a copy that is behind. */
  :: atomic { copy[s] != NONE && copy[s] < DECISIONS && copy[s] <= acknowledged -> copy[s]++; write(s) }
  /* SessionGate::Refused(): the request is ahead of the copy. */
  :: atomic {
       copy[s] != NONE && copy[s] < acknowledged ->
#ifndef GIVE_UP
       former[s] = copy[s];  /* FormerCopies::Keep() */
#endif
       copy[s] = NONE;
       claim(s)
     }
  :: atomic { copy[s] == NONE && stored -> claim(s) }
  /* FormerCopies::TakeBack(): at any time, also while another server has a newer copy. */
  :: atomic {
       copy[s] == NONE && !stored && former[s] != NONE ->
       copy[s] = former[s]; former[s] = NONE; write(s)
     }
  od
}

active proctype Redis() {
  do
  :: atomic { stored && evictions < MOST_EVICTIONS && copy[0] + copy[1] < 2 * NONE ->
       evictions++; stored = false; check_copies() }
  od
}

init { atomic { copy[0] = 0; epoch[0] = 1; claimed_from[0] = 0; run Server(0); run Server(1) } }
