/* Models a Redis that removes a session while servers take it from each other (docs/design/durability.md): which copies
 * there are, and which of them goes on.
 *
 * Three servers; a client without affinity asks any of them at any time. A server whose copy is behind the request, or
 * which cannot tell, gives it up and claims the session. Redis removes the session at any time, both keys at once. A
 * server writes the copy again that it has, also if another one has claimed the session and it does not know. No server
 * dies.
 *
 * Checked, by assertions:
 * - all that an owner has acknowledged is in some copy of the session: in Redis, of a server, or one that a server has
 *   given up and kept;
 * - what an owner acknowledges is in Redis then.
 *
 * Each of these is the old protocol, or lacks a part, so that the check must fail:
 * -DGIVE_UP       a server drops the copy that it has given up, also if Redis has nothing
 * -DNO_FENCE      an owner that another one has replaced goes on
 * -DCLAIMED_ONLY  an owner replaces only what it had claimed, so that the older copy of another server fences it
 * -DANY_CLAIM     a server that claims an older copy forgets the one that it had given up
 *
 * run_model.py runs SPIN on this file. Behind each transition stands the function that implements it. */

#define SERVERS 3
#define DECISIONS 2
#define MOST_CLAIMS 3
#define MOST_EVICTIONS 2
#define NONE 99

/* Redis: the hash, and what its journal makes of the session. */
bool stored = true;
byte stored_epoch = 1;
byte stored_decisions = 0;

/* Of each server: SessionEntry, SessionJournal, GivenUpCopies. */
byte copy[SERVERS] = NONE;    /* decisions of it */
byte durable[SERVERS];        /* of these, acknowledged by Redis */
byte epoch[SERVERS];
byte claimed_from[SERVERS];
byte former[SERVERS] = NONE;  /* given up, and kept */

byte acknowledged = 0;        /* decisions whose answers the client has */
byte next_epoch = 2;          /* a claim adds a random number: no two have the same epoch */
byte claims = 0;
byte evictions = 0;

#define HAS(n) (n != NONE && n >= acknowledged)

inline check_copies() {
  assert((stored && stored_decisions >= acknowledged) || HAS(copy[0]) || HAS(copy[1]) || HAS(copy[2]) ||
         HAS(former[0]) || HAS(former[1]) || HAS(former[2]))
}

inline acknowledge(s) {
  assert(stored && stored_decisions == copy[s]);
  durable[s] = copy[s];
  acknowledged = (copy[s] > acknowledged -> copy[s] : acknowledged)
}

/* RedisBackend::WriteAll(), FindReason(), MostReplaced(), JournalStore::WriteAgain(): an entry, or the whole session. */
inline write(s) {
  if
  :: !stored || stored_epoch == epoch[s] ->
    stored = true; stored_epoch = epoch[s]; stored_decisions = copy[s];
    acknowledge(s)
  :: stored && stored_epoch != epoch[s] && stored_epoch == claimed_from[s] && stored_decisions <= durable[s] ->
    stored_epoch = epoch[s]; stored_decisions = copy[s];
    acknowledge(s)
#ifndef CLAIMED_ONLY
  :: stored && stored_epoch != epoch[s] && stored_epoch != claimed_from[s] && stored_decisions < durable[s] ->
    epoch[s] = next_epoch; next_epoch++;
    stored_epoch = epoch[s]; stored_decisions = copy[s];
    acknowledge(s)
#endif
  :: else ->
#ifdef NO_FENCE
    acknowledge(s)
#else
    copy[s] = NONE  /* SessionJournal::OnWritten(): the copy is lost */
#endif
  fi;
  check_copies()
}

/* SessionRecovery::Recover(), Restore(), GoOnFrom(), RedisBackend::RunClaims(). */
inline claim(s) {
  if
  :: stored && claims < MOST_CLAIMS ->
    claims++;
    claimed_from[s] = stored_epoch; epoch[s] = next_epoch; stored_epoch = next_epoch; next_epoch++;
    copy[s] = stored_decisions;
#ifndef ANY_CLAIM
    if
    :: former[s] != NONE && former[s] > copy[s] -> copy[s] = former[s]
    :: else
    fi;
#endif
    durable[s] = copy[s];
    former[s] = NONE
  :: else
  fi;
  check_copies()
}

proctype Server(byte s) {
  do
  /* DecideActs(): the next decision, or one that is sent again to a copy that is behind. */
  :: atomic { copy[s] != NONE && copy[s] < DECISIONS && copy[s] <= acknowledged -> copy[s]++; write(s) }
  /* JournalStore::CheckJournals(): nothing is asked for, and the session is written if it is not there. */
  :: atomic { copy[s] != NONE && !(stored && stored_epoch == epoch[s] && stored_decisions == copy[s]) -> write(s) }
  /* SessionGate::Refused(): the request is ahead of the copy, or does not name its place. */
  :: atomic {
       copy[s] != NONE ->
#ifndef GIVE_UP
       former[s] = copy[s];  /* GivenUpCopies::Keep() */
#endif
       copy[s] = NONE;
       claim(s)
     }
  :: atomic { copy[s] == NONE && stored -> claim(s) }
  /* GivenUpCopies::TakeBack(): at any time, also while another server has a newer copy. */
  :: atomic {
       copy[s] == NONE && !stored && former[s] != NONE ->
       copy[s] = former[s]; durable[s] = copy[s]; former[s] = NONE; write(s)
     }
  od
}

proctype Redis() {
  do
  :: atomic { stored && evictions < MOST_EVICTIONS -> evictions++; stored = false; check_copies() }
  od
}

init { atomic { copy[0] = 0; epoch[0] = 1; run Server(0); run Server(1); run Server(2); run Redis() } }
