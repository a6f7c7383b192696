/* Models which copy of a session answers a request: ends of episodes, requests without `decision`, retries and hedged
 * requests without affinity, over two replicas with one store (docs/guides/fleet.md).
 *
 * A session is a sequence of events: two decisions, the end of the episode, two decisions, and so on. A copy of it is how
 * many of them a replica has seen. The client sends the next event to any replica, and the last one again.
 *
 * Checked, by assertions:
 * - an answer that the client gets is that of its request;
 * - the next request of a correct client is never refused.
 *
 * Each of these is the old protocol, so that the check must fail:
 * -DDECISION_ONLY  a copy is older than a request if its decision is (an end changes none)
 * -DNO_CONFIRM     a request without `decision` is answered without asking the store who owns the session
 * -DASYNC_AT_ONCE  durability ASYNC: a decision without `decision` is answered before the store has it
 *
 * run_model.py runs SPIN on this file. */

#define EVENTS 7
#define MOST_CLAIMS 5

#define IS_END(k) ((k) % 3 == 2)
#define STEP(k) ((k) % 3)                              /* Session::step after k events */
#define DECISIONS(k) (((k) / 3) * 2 + (k) % 3)         /* Session::decisions after k events */

byte stored = 0;   /* events in the journal */
byte owner = 0;    /* the replica that has claimed it last */
byte claims = 0;
byte next = 0;     /* the event that the client waits for */

chan requests[2] = [0] of { byte, bool };   /* event, whether it has `decision`, or `episode` and `steps` */

/* An answer or an error reaches the client. A late one, of an event before the last, is not listened to. */
inline answer(event, k) {
  if
  :: k + 1 >= next -> assert(event == k)
  :: else
  fi;
  if
  :: k == next && event == k -> next++
  :: else
  fi
}

inline refuse(k) {
  assert(k != next)
}

proctype Replica(byte me) {
  byte copy = 0;
  bool holds = (me == 0);
  bool numbered = false;
  bool is_retry = false;
  bool fits = false;
  bool claimed = false;
  byte k = 0;
idle:
  atomic { k = 0; numbered = false; is_retry = false; fits = false; claimed = false };
  requests[me]?k, numbered;
again:
  /* SessionRecovery::Recover(), kClaim */
  if
  :: atomic { !holds && claims < MOST_CLAIMS -> claims++; owner = me; copy = stored; holds = true; claimed = true }
  :: atomic { !holds && claims == MOST_CLAIMS -> goto idle }
  :: holds
  fi;
  /* AgentSession::IsNewDecision(), CheckEpisode() */
  atomic {
    is_retry = copy > 0 && STEP(copy - 1) == STEP(k) && (!numbered || copy - 1 == k);
    fits = STEP(copy) == STEP(k) && (!numbered || copy == k);
    /* An end may come after the first decision, too, but this client's do not. */
    if
    :: is_retry -> goto retry
    :: !is_retry && fits -> goto new
    :: else -> goto mismatch
    fi
  };
retry:
  /* AddConfirmation(), SessionJournal::OnConfirm(): the request proves it, or the store does. */
#ifdef NO_CONFIRM
  atomic { answer(copy - 1, k); goto idle };
#else
  if
  :: atomic { numbered -> answer(copy - 1, k); goto idle }
  :: atomic { !numbered && owner == me -> answer(copy - 1, k); goto idle }
  :: atomic { !numbered && owner != me -> holds = false; copy = 0; goto idle }  /* UNAVAILABLE */
  fi;
#endif
new:
  /* AgentSession::Decide(), RPUSHX: fenced */
#ifdef ASYNC_AT_ONCE
  atomic { copy++; answer(copy - 1, k) };
#endif
  if
  :: atomic {
       owner == me ->
#ifndef ASYNC_AT_ONCE
       copy++;
       stored = copy;
       answer(copy - 1, k);
#else
       stored = copy;
#endif
       goto idle
     }
  :: atomic { owner != me -> holds = false; copy = 0; goto idle }
  fi;
mismatch:
  /* IsAhead(), MayBeOutdated(): the copy may be an old one, and the session is claimed again. */
  atomic {
    if
#ifdef DECISION_ONLY
    :: !claimed && numbered && DECISIONS(k) > DECISIONS(copy) -> holds = false; goto again
    :: !claimed && !numbered && STEP(k) > STEP(copy) -> holds = false; goto again
#else
    :: !claimed && numbered && (DECISIONS(k) > DECISIONS(copy) ||
                                (DECISIONS(k) == DECISIONS(copy) && STEP(k) < STEP(copy)) || (IS_END(k) && k > copy)) ->
      holds = false; goto again
    :: !claimed && !numbered -> holds = false; goto again
#endif
    :: else ->
      if
      :: owner == me && copy == stored && k != next -> skip
      :: owner != me && claimed -> skip  /* another one was faster; it is asked again */
      :: else -> refuse(k)
      fi;
      goto idle
    fi
  }
}

active proctype Client() {
  atomic { run Replica(0); run Replica(1) };
  do
  :: next < EVENTS -> requests[0]!next, true
  :: next < EVENTS -> requests[1]!next, true
  :: next < EVENTS -> requests[0]!next, false
  :: next < EVENTS -> requests[1]!next, false
  /* Once more: a retry, or the other half of a hedged request. */
  :: next > 0 -> requests[0]!next - 1, true
  :: next > 0 -> requests[1]!next - 1, false
  :: next > 0 -> requests[0]!next - 1, false
  od
}
