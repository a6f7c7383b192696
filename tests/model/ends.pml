/* Models what a client keeps of an ASYNC session, so that it can send again what only its server's memory had: decisions
 * and ends of episodes, acknowledged and not stored yet, when the server dies or another one takes the session over.
 *
 * A session is a sequence of events: two decisions, the end of the episode, and so on. An answer says how many decisions
 * and how many ends the store has (ActResponse.durable_decision, .durable_episode). An error says what the server expects.
 *
 * Checked, by assertions:
 * - the client still has what a server expects;
 * - what it sends then is in its place.
 *
 * Each of these is the old protocol, so that the check must fail:
 * -DFORGET_ENDED    the client keeps nothing of an episode whose end was answered
 * -DDECISIONS_ONLY  an answer says how many decisions the store has, and the client takes the end behind them for stored
 * -DNO_EPISODE      an error says which decision is expected, and not of which episode
 *
 * run_model.py runs SPIN on this file. Behind each transition stands the function that implements it. */

#define EVENTS 7
#define MOST_LOSSES 2

#define IS_END(k) ((k) % 3 == 2)
#define DECISIONS(k) (((k) / 3) * 2 + (k) % 3)  /* Session::decisions after k events */
#define EPISODES(k) ((k) / 3)                   /* Session::episode after k events */

byte stored = 0;  /* events in the journal */
byte copy = 0;    /* events that the server has */
byte losses = 0;

byte next = 0;    /* events that were answered */
byte kept = 0;    /* the first event that the client has */
byte at = 0;      /* the event that it sends */

/* Forgets events that the answer to event `at` says are stored. */
inline forget() {
#ifdef FORGET_ENDED
  if
  :: IS_END(at) -> kept = at + 1
  :: else
  fi
#else
  do
  :: kept < next && !IS_END(kept) && DECISIONS(kept + 1) <= DECISIONS(stored) -> kept++
#ifdef DECISIONS_ONLY
  :: kept < next && IS_END(kept) && DECISIONS(kept + 1) <= DECISIONS(stored) -> kept++
#else
  :: kept < next && IS_END(kept) && EPISODES(kept + 1) <= EPISODES(stored) -> kept++
#endif
  :: else -> break
  od
#endif
}

active proctype Client() {
  do
  :: atomic {
       at < EVENTS ->
       if
       /* PolicyHandler: a new event, or one that is repeated. */
       :: at == copy -> copy++; next = (at + 1 > next -> at + 1 : next); forget(); at++
       :: at < copy -> forget(); at++
       /* SessionGate::Refused(), WithExpectedDecision() */
       :: at > copy ->
         assert(kept <= copy);
#ifdef NO_EPISODE
         at = copy + (IS_END(copy) -> 1 : 0);  /* the first one with this number of decisions before it that decides */
         assert(at == copy)
#else
         at = copy
#endif
       fi
     }
  od
}

active proctype Store() {
  do
  :: atomic { stored < copy -> stored++ }  /* SessionJournal::OnWritten() */
  /* The server dies, or is fenced while it cannot reach the store: SessionRecovery::Restore(). */
  :: atomic { losses < MOST_LOSSES && stored < copy -> losses++; copy = stored }
  od
}
