/* A stand-in for libusb-1.0.so.0: a USB bus whose cameras are processes behind Unix sockets.
 *
 * Aravis loads it in place of the real library, and so runs its own USB3 Vision code unchanged. The
 * folder DCAM_TEST_USB_BUS is the bus: each `*.usb` in it is the socket of a camera (server.py). A
 * socket that takes no connection is a camera that is not plugged in. Of libusb's calls those that
 * Aravis 0.8 makes are here; a transfer is asynchronous, the control endpoint alone is not.
 *
 * To the camera lead two sockets a handle: one for control, one for the stream. A message is its
 * length and an epoch, 32 bits each, then the bytes. Each start and stop of the stream begins an
 * epoch; what was sent in an earlier one is dropped, as a halted endpoint drops it.
 *
 * With DCAM_TEST_USB_SLOW_EVENTS the thread that handles events runs only when no other wants to.
 */
#define _GNU_SOURCE
#include <dirent.h>
#include <errno.h>
#include <libusb-1.0/libusb.h>
#include <poll.h>
#include <pthread.h>
#include <sched.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <sys/un.h>
#include <unistd.h>

enum { CONTROL_OUT = 0x01, CONTROL_IN = 0x81, STREAM_IN = 0x82 };
enum { MANUFACTURER = 1, PRODUCT, SERIAL, GUID };
enum { MAX_DEVICES = 8, MAX_HANDLES = 16, GREETING_MS = 2000 };

struct libusb_device {
  libusb_context *context;
  int references;
  struct sockaddr_un address;
};

typedef struct Pending {
  struct Pending *next;
  struct libusb_transfer *transfer;
  int cancelled;
} Pending;

typedef struct Head {
  uint32_t length, epoch;
} Head;

/* What a camera says when it is opened. */
typedef struct Greeting {
  int32_t status; /* 0, or an error of libusb's */
  char serial[32], guid[32];
} Greeting;

struct libusb_device_handle {
  libusb_device *device;
  Greeting greeting;
  int control, stream; /* sockets */
  volatile uint32_t epoch;
  int gone, gone_said;
  Pending *pending;
  /* the message that is being read from the stream */
  Head head;
  size_t n_head, n_body;
  Pending *into; /* NULL: it is dropped */
};

struct libusb_context {
  pthread_mutex_t mutex;
  int wake;
  libusb_device_handle *handles[MAX_HANDLES];
  libusb_hotplug_callback_fn hotplug;
  void *hotplug_data;
};

/* ---------------------------------------------------------------- sockets */

static int connect_to(const struct sockaddr_un *address) {
  int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
  if (fd >= 0 && connect(fd, (const struct sockaddr *)address, sizeof *address) == 0) return fd;
  if (fd >= 0) close(fd);
  return -1;
}

static int send_all(int fd, const void *data, size_t n) {
  for (size_t sent = 0; sent < n;) {
    ssize_t k = send(fd, (const char *)data + sent, n - sent, MSG_NOSIGNAL);
    if (k <= 0) return -1;
    sent += k;
  }
  return 0;
}

/* 1: all of it is there, 0: not in time, -1: the other end is gone. */
static int receive_all(int fd, void *data, size_t n, int timeout_ms) {
  for (size_t got = 0; got < n;) {
    struct pollfd ready = {fd, POLLIN, 0};
    if (poll(&ready, 1, timeout_ms) == 0) return 0;
    ssize_t k = recv(fd, (char *)data + got, n - got, 0);
    if (k <= 0) return -1;
    got += k;
  }
  return 1;
}

static void wake(libusb_context *context) {
  uint64_t one = 1;
  if (write(context->wake, &one, sizeof one) < 0) perror("stand-in for libusb: wake");
}

/* ---------------------------------------------------------------- library and devices */

int libusb_init(libusb_context **context) {
  *context = calloc(1, sizeof **context);
  pthread_mutex_init(&(*context)->mutex, NULL);
  (*context)->wake = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
  return 0;
}

void libusb_exit(libusb_context *context) {
  close(context->wake);
  free(context);
}

ssize_t libusb_get_device_list(libusb_context *context, libusb_device ***list) {
  const char *bus = getenv("DCAM_TEST_USB_BUS");
  struct dirent **entries = NULL;
  int n_entries = bus ? scandir(bus, &entries, NULL, alphasort) : 0, n = 0;
  *list = calloc(MAX_DEVICES + 1, sizeof **list);
  for (int i = 0; i < n_entries; i++) {
    const char *name = entries[i]->d_name;
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    int fd = -1;
    int length = snprintf(address.sun_path, sizeof address.sun_path, "%s/%s", bus, name);
    int fits = length > 4 && (size_t)length < sizeof address.sun_path;
    if (fits && !strcmp(address.sun_path + length - 4, ".usb")) fd = connect_to(&address);
    if (fd >= 0) close(fd);
    if (fd >= 0 && n < MAX_DEVICES) {
      libusb_device *device = calloc(1, sizeof *device);
      *device = (libusb_device){context, 1, address};
      (*list)[n++] = device;
    }
    free(entries[i]);
  }
  free(entries);
  return n;
}

static void unreference(libusb_device *device) {
  if (__sync_sub_and_fetch(&device->references, 1) == 0) free(device);
}

void libusb_free_device_list(libusb_device **list, int unreference_devices) {
  for (int i = 0; unreference_devices && list[i]; i++) unreference(list[i]);
  free(list);
}

/* USB3 Vision 1.1, 4.1: device, interfaces and endpoints; FLIR's vendor id. */
int libusb_get_device_descriptor(libusb_device *device, struct libusb_device_descriptor *out) {
  (void)device;
  *out = (struct libusb_device_descriptor){
      .bLength = 18, .bDescriptorType = LIBUSB_DT_DEVICE, .bcdUSB = 0x300, .bDeviceClass = 0xef,
      .bDeviceSubClass = 2, .bDeviceProtocol = 1, .idVendor = 0x1e10, .idProduct = 0x3300,
      .iManufacturer = MANUFACTURER, .iProduct = PRODUCT, .iSerialNumber = SERIAL,
      .bNumConfigurations = 1};
  return 0;
}

/* Versions of GenCP and USB3 Vision, then the numbers of the strings, then the speeds. */
static const unsigned char device_info[20] = {
    20, 0x24, 1, 0, 0, 1, 0, 0, 0, 1, 0, GUID, MANUFACTURER, PRODUCT, 0, 0, 0, SERIAL, 0, 0x0c};
#define BULK(address) {7, LIBUSB_DT_ENDPOINT, address, 2, 1024, 0, 0, 0, NULL, 0}
static const struct libusb_endpoint_descriptor control_ends[] = {BULK(CONTROL_IN), BULK(CONTROL_OUT)};
static const struct libusb_endpoint_descriptor stream_ends[] = {BULK(STREAM_IN)};
static const struct libusb_interface_descriptor control_interface = {
    9, LIBUSB_DT_INTERFACE, 0, 0, 2, 0xef, 5, 0, 0, control_ends, device_info, sizeof device_info};
static const struct libusb_interface_descriptor stream_interface = {
    9, LIBUSB_DT_INTERFACE, 1, 0, 1, 0xef, 5, 2, 0, stream_ends, NULL, 0};
static const struct libusb_interface interfaces[] = {{&control_interface, 1}, {&stream_interface, 1}};
static struct libusb_config_descriptor configuration = {
    9, LIBUSB_DT_CONFIG, 50, 2, 1, 0, 0xc0, 100, interfaces, NULL, 0};

int libusb_get_config_descriptor(
    libusb_device *device, uint8_t index, struct libusb_config_descriptor **out) {
  (void)device, (void)index;
  *out = &configuration;
  return 0;
}

void libusb_free_config_descriptor(struct libusb_config_descriptor *config) { (void)config; }

const char *libusb_error_name(int error) {
  switch (error) {
    case LIBUSB_ERROR_IO: return "LIBUSB_ERROR_IO";
    case LIBUSB_ERROR_ACCESS: return "LIBUSB_ERROR_ACCESS";
    case LIBUSB_ERROR_NO_DEVICE: return "LIBUSB_ERROR_NO_DEVICE";
    case LIBUSB_ERROR_BUSY: return "LIBUSB_ERROR_BUSY";
    case LIBUSB_ERROR_TIMEOUT: return "LIBUSB_ERROR_TIMEOUT";
    case LIBUSB_ERROR_OVERFLOW: return "LIBUSB_ERROR_OVERFLOW";
    default: return "LIBUSB_ERROR_OTHER";
  }
}

/* ---------------------------------------------------------------- handles */

static int greet(libusb_device_handle *handle) {
  static uint64_t last;
  uint64_t id[2] = {getpid(), __sync_add_and_fetch(&last, 1)};
  handle->control = connect_to(&handle->device->address);
  handle->stream = connect_to(&handle->device->address);
  if (handle->control < 0 || handle->stream < 0) return LIBUSB_ERROR_NO_DEVICE;
  if (send_all(handle->control, "C", 1) || send_all(handle->control, id, sizeof id) ||
      send_all(handle->stream, "S", 1) || send_all(handle->stream, id, sizeof id))
    return LIBUSB_ERROR_NO_DEVICE;
  int got = receive_all(handle->control, &handle->greeting, sizeof handle->greeting, GREETING_MS);
  return got == 1 ? handle->greeting.status : got ? LIBUSB_ERROR_NO_DEVICE : LIBUSB_ERROR_TIMEOUT;
}

static void discard(libusb_device_handle *handle) {
  if (handle->control >= 0) close(handle->control);
  if (handle->stream >= 0) close(handle->stream);
  unreference(handle->device);
  free(handle);
}

int libusb_open(libusb_device *device, libusb_device_handle **out) {
  libusb_device_handle *handle = calloc(1, sizeof *handle);
  libusb_context *context = device->context;
  handle->device = device;
  __sync_add_and_fetch(&device->references, 1);
  int error = greet(handle), i = 0;
  pthread_mutex_lock(&context->mutex);
  while (i < MAX_HANDLES && context->handles[i]) i++;
  if (!error && i == MAX_HANDLES) error = LIBUSB_ERROR_NO_MEM;
  if (!error) context->handles[i] = *out = handle;
  pthread_mutex_unlock(&context->mutex);
  if (error) discard(handle);
  return error;
}

void libusb_close(libusb_device_handle *handle) {
  libusb_context *context = handle->device->context;
  pthread_mutex_lock(&context->mutex);
  for (int i = 0; i < MAX_HANDLES; i++)
    if (context->handles[i] == handle) context->handles[i] = NULL;
  while (handle->pending) {
    Pending *next = handle->pending->next;
    free(handle->pending);
    handle->pending = next;
  }
  pthread_mutex_unlock(&context->mutex);
  discard(handle);
}

libusb_device *libusb_get_device(libusb_device_handle *handle) { return handle->device; }

int libusb_get_string_descriptor_ascii(
    libusb_device_handle *handle, uint8_t index, unsigned char *out, int size) {
  const char *strings[] = {
      "", "Point Grey Research", "Grasshopper3 GS3-U3-23S6M", handle->greeting.serial,
      handle->greeting.guid};
  return snprintf((char *)out, size, "%s", index <= GUID ? strings[index] : "");
}

int libusb_set_auto_detach_kernel_driver(libusb_device_handle *handle, int enable) {
  (void)handle, (void)enable;
  return 0;
}

int libusb_clear_halt(libusb_device_handle *handle, unsigned char endpoint) {
  (void)endpoint;
  return handle->gone ? LIBUSB_ERROR_NO_DEVICE : 0;
}

int libusb_control_transfer(
    libusb_device_handle *handle, uint8_t type, uint8_t request, uint16_t value, uint16_t index,
    unsigned char *data, uint16_t length, unsigned int timeout_ms) {
  (void)type, (void)request, (void)value, (void)index, (void)data, (void)length, (void)timeout_ms;
  return handle->gone ? LIBUSB_ERROR_NO_DEVICE : 0;
}

/* ---------------------------------------------------------------- control */

static int ask(libusb_device_handle *handle, const void *data, size_t n) {
  Head head = {n, 0};
  int failed = send_all(handle->control, &head, sizeof head) || send_all(handle->control, data, n);
  return failed ? LIBUSB_ERROR_NO_DEVICE : 0;
}

static int answer(libusb_device_handle *handle, void *data, size_t n, int *got, int timeout_ms) {
  Head head;
  char rest[4096];
  int state = receive_all(handle->control, &head, sizeof head, timeout_ms ? timeout_ms : -1);
  if (state <= 0) return state ? LIBUSB_ERROR_NO_DEVICE : LIBUSB_ERROR_TIMEOUT;
  size_t taken = head.length < n ? head.length : n;
  if (head.length - taken > sizeof rest) abort();
  if (receive_all(handle->control, data, taken, GREETING_MS) != 1 ||
      receive_all(handle->control, rest, head.length - taken, GREETING_MS) != 1)
    return LIBUSB_ERROR_NO_DEVICE;
  handle->epoch = head.epoch;
  *got = taken;
  return 0;
}

/* One program at a time has an interface: the camera keeps the account, by handle. */
int libusb_claim_interface(libusb_device_handle *handle, int number) {
  int32_t error;
  int got;
  (void)number;
  int failed = ask(handle, "claim", 5);
  if (!failed) failed = answer(handle, &error, sizeof error, &got, GREETING_MS);
  return failed ? failed : error;
}

int libusb_release_interface(libusb_device_handle *handle, int number) {
  int32_t error;
  int got;
  (void)number;
  int failed = ask(handle, "release", 7);
  return failed ? failed : answer(handle, &error, sizeof error, &got, GREETING_MS);
}

int libusb_bulk_transfer(
    libusb_device_handle *handle, unsigned char endpoint, unsigned char *data, int length, int *got,
    unsigned int timeout_ms) {
  int ignored;
  if (!got) got = &ignored;
  *got = 0;
  if (endpoint == CONTROL_OUT) {
    int error = ask(handle, data, length);
    *got = error ? 0 : length;
    return error;
  }
  if (endpoint == CONTROL_IN) return answer(handle, data, length, got, timeout_ms);
  return LIBUSB_ERROR_NOT_SUPPORTED;
}

/* ---------------------------------------------------------------- stream */

struct libusb_transfer *libusb_alloc_transfer(int n_packets) {
  (void)n_packets;
  return calloc(1, sizeof(struct libusb_transfer));
}

void libusb_free_transfer(struct libusb_transfer *transfer) { free(transfer); }

int libusb_submit_transfer(struct libusb_transfer *transfer) {
  libusb_device_handle *handle = transfer->dev_handle;
  libusb_context *context = handle->device->context;
  pthread_mutex_lock(&context->mutex);
  int gone = handle->gone;
  if (!gone) {
    Pending *added = calloc(1, sizeof *added), **end = &handle->pending;
    added->transfer = transfer;
    while (*end) end = &(*end)->next;
    *end = added;
  }
  pthread_mutex_unlock(&context->mutex);
  wake(context);
  return gone ? LIBUSB_ERROR_NO_DEVICE : 0;
}

int libusb_cancel_transfer(struct libusb_transfer *transfer) {
  libusb_device_handle *handle = transfer->dev_handle;
  libusb_context *context = handle->device->context;
  int error = LIBUSB_ERROR_NOT_FOUND;
  pthread_mutex_lock(&context->mutex);
  for (Pending *one = handle->pending; one; one = one->next)
    if (one->transfer == transfer) one->cancelled = 1, error = 0;
  pthread_mutex_unlock(&context->mutex);
  wake(context);
  return error;
}

/* The three below are called with the context's mutex held. */

static void finish(libusb_context *context, libusb_device_handle *handle, Pending *done, int status) {
  struct libusb_transfer *transfer = done->transfer;
  Pending **link = &handle->pending;
  while (*link != done) link = &(*link)->next;
  *link = done->next;
  if (handle->into == done) handle->into = NULL;
  free(done);
  transfer->status = status;
  pthread_mutex_unlock(&context->mutex);
  transfer->callback(transfer);
  pthread_mutex_lock(&context->mutex);
}

/* Whether a transfer that was cancelled, or whose camera is gone, could be given back. */
static int give_up_one(libusb_context *context, libusb_device_handle *handle) {
  for (Pending *one = handle->pending; one; one = one->next) {
    if (!one->cancelled && !handle->gone) continue;
    one->transfer->actual_length = 0;
    finish(context, handle, one,
           one->cancelled ? LIBUSB_TRANSFER_CANCELLED : LIBUSB_TRANSFER_NO_DEVICE);
    return 1;
  }
  return 0;
}

/* Whether some bytes of the stream could be read. A transfer takes the whole of a message. */
static int read_some(libusb_context *context, libusb_device_handle *handle) {
  char dropped[65536];
  void *where = (char *)&handle->head + handle->n_head;
  size_t want = sizeof handle->head - handle->n_head, room = 0;
  int in_body = want == 0;
  if (in_body) {
    size_t length = handle->into ? (size_t)handle->into->transfer->length : 0;
    room = handle->n_body < length ? length - handle->n_body : 0;
    where = room ? (void *)(handle->into->transfer->buffer + handle->n_body) : dropped;
    want = handle->head.length - handle->n_body;
    if (want > (room ? room : sizeof dropped)) want = room ? room : sizeof dropped;
  }
  ssize_t got = recv(handle->stream, where, want, MSG_DONTWAIT);
  if (got <= 0) return 0;
  if (!in_body) {
    handle->n_head += got;
    if (handle->n_head == sizeof handle->head && handle->head.epoch >= handle->epoch)
      handle->into = handle->pending;
    return 1;
  }
  handle->n_body += got;
  if (handle->n_body == handle->head.length) {
    Pending *done = handle->into;
    size_t sent = handle->head.length;
    handle->n_head = handle->n_body = 0;
    if (done) {
      size_t length = done->transfer->length;
      done->transfer->actual_length = sent < length ? sent : length;
      finish(context, handle, done,
             sent > length ? LIBUSB_TRANSFER_OVERFLOW : LIBUSB_TRANSFER_COMPLETED);
    }
  }
  return 1;
}

static void say_gone(libusb_context *context, libusb_device_handle *handle) {
  libusb_hotplug_callback_fn hotplug = context->hotplug;
  void *data = context->hotplug_data;
  handle->gone_said = 1;
  if (!hotplug) return;
  pthread_mutex_unlock(&context->mutex);
  hotplug(context, handle->device, LIBUSB_HOTPLUG_EVENT_DEVICE_LEFT, data);
  pthread_mutex_lock(&context->mutex);
}

static int handle_one(libusb_context *context, libusb_device_handle *handle, short state) {
  if (state & (POLLHUP | POLLRDHUP)) handle->gone = 1;
  if (handle->gone && !handle->gone_said) {
    say_gone(context, handle);
    return 1;
  }
  if (give_up_one(context, handle)) return 1;
  return handle->pending && !handle->gone && read_some(context, handle);
}

int libusb_handle_events_timeout(libusb_context *context, struct timeval *timeout) {
  struct pollfd ready[1 + 2 * MAX_HANDLES] = {{context->wake, POLLIN, 0}};
  uint64_t wakes;
  if (getenv("DCAM_TEST_USB_SLOW_EVENTS"))
    sched_setscheduler(0, SCHED_IDLE, &(struct sched_param){0});
  pthread_mutex_lock(&context->mutex);
  for (int i = 0; i < MAX_HANDLES; i++) {
    libusb_device_handle *handle = context->handles[i];
    int watched = handle && !(handle->gone && handle->gone_said);
    ready[1 + 2 * i] = (struct pollfd){watched ? handle->control : -1, POLLRDHUP, 0};
    ready[2 + 2 * i] = (struct pollfd){watched && handle->pending ? handle->stream : -1, POLLIN, 0};
  }
  pthread_mutex_unlock(&context->mutex);
  poll(ready, 1 + 2 * MAX_HANDLES, timeout->tv_sec * 1000 + timeout->tv_usec / 1000);
  while (read(context->wake, &wakes, sizeof wakes) > 0) continue;
  pthread_mutex_lock(&context->mutex);
  for (int i = 0; i < MAX_HANDLES; i++)
    while (context->handles[i] && handle_one(context, context->handles[i], ready[1 + 2 * i].revents))
      continue;
  pthread_mutex_unlock(&context->mutex);
  return 0;
}

int libusb_hotplug_register_callback(
    libusb_context *context, int events, int flags, int vendor, int product, int device_class,
    libusb_hotplug_callback_fn callback, void *data, libusb_hotplug_callback_handle *out) {
  (void)events, (void)flags, (void)vendor, (void)product, (void)device_class;
  pthread_mutex_lock(&context->mutex);
  context->hotplug = callback;
  context->hotplug_data = data;
  pthread_mutex_unlock(&context->mutex);
  if (out) *out = 1;
  return 0;
}

void libusb_hotplug_deregister_callback(
    libusb_context *context, libusb_hotplug_callback_handle handle) {
  (void)handle;
  pthread_mutex_lock(&context->mutex);
  context->hotplug = NULL;
  pthread_mutex_unlock(&context->mutex);
}
