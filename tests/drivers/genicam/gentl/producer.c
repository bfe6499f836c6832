/* A GenTL producer over libaravis: what a camera vendor's .cti is, for the tests.
 *
 * It offers every camera that Aravis finds, as one system with one interface, one data stream a
 * device, and the "new buffer" event. Functions and numbers are those of the GenICam GenTL standard,
 * version 1.5; what a consumer may do without answers GC_ERR_NOT_IMPLEMENTED.
 *
 *     gcc -shared -fPIC -Wl,-z,nodelete producer.c -o producer.cti $(pkg-config ... aravis-0.8)
 *
 * With -D it has a habit of real producers:
 *   FOREIGN        lists a device of another vendor first, which reports no serial number
 *   TWICE          lists each camera twice, with the same id
 *   TWO_WAYS       lists each camera twice, first by a way on which it cannot be opened
 *   NAMESAKE       lists a device of another vendor with each camera's serial number
 *   BAD_DEVICE     fails when it is asked for the id of its last device
 *   BAD_INTERFACE  has a second interface, which fails when it looks for devices
 *
 * `nodelete`: a consumer unloads a producer to look for devices again, and GLib's types must not go.
 */
#include <arv.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef int32_t GC_ERROR;
typedef int32_t INFO_DATATYPE;
typedef uint8_t bool8_t;

enum {
  OK = 0, ERR_ERROR = -1001, ERR_NOT_INITIALIZED = -1002, ERR_NOT_IMPLEMENTED = -1003,
  ERR_RESOURCE_IN_USE = -1004, ERR_ACCESS_DENIED = -1005, ERR_INVALID_HANDLE = -1006,
  ERR_INVALID_ID = -1007, ERR_NO_DATA = -1008, ERR_INVALID_PARAMETER = -1009, ERR_IO = -1010,
  ERR_TIMEOUT = -1011, ERR_ABORT = -1012, ERR_NOT_AVAILABLE = -1014, ERR_BUFFER_TOO_SMALL = -1016,
  ERR_INVALID_INDEX = -1017
};
enum { TYPE_STRING = 1, TYPE_INT32 = 5, TYPE_UINT32 = 6, TYPE_UINT64 = 8, TYPE_PTR = 10,
       TYPE_BOOL8 = 11, TYPE_SIZET = 12 };
enum { EVENT_NEW_BUFFER = 1 };

static const char *const SYSTEM_ID = "dcam-test-system";
static const char *const INTERFACE_ID = "dcam-test-interface";
static const char *const STREAM_ID = "stream0";
/* The description is offered in a part of the address space that no camera uses. */
static const uint64_t XML_ADDRESS = 0x7000000000000000u;

typedef struct Buffer {
  ArvBuffer *arv;          /* the frame it was delivered with */
  void *data, *user;
  size_t size;
  bool8_t queued;
} Buffer;

/* What a port is asked through: only the remote device has registers and a description. */
typedef struct Port {
  enum { NO_PORT, REMOTE_PORT } kind;
} Port;

typedef struct Device {
  Port module;
  Port remote;
  Port stream_port;        /* the handle of the data stream */
  ArvCamera *camera;
  char *id, *serial, *vendor, *model;
  /* its one data stream and that stream's event */
  ArvStream *stream;
  GPtrArray *buffers;      /* Buffer*, in the order of announcement */
  bool8_t stream_open, grabbing, event_registered;
  volatile gint killed;
  uint64_t delivered;
} Device;

/* A handle is the address of one of these, of a Device, or of a part of a Device. */
static int initialized;
static Port system_handle, interface_handle;
static char last_error[256] = "no error";

static GC_ERROR failed(GC_ERROR code, const char *why) {
  g_strlcpy(last_error, why, sizeof last_error);
  return code;
}

static GC_ERROR failed_with(GError *error) {
  GC_ERROR code = g_error_matches(error, ARV_DEVICE_ERROR, ARV_DEVICE_ERROR_TIMEOUT)
                      ? ERR_TIMEOUT : ERR_IO;
  failed(code, error->message);
  g_error_free(error);
  return code;
}

/* ------------------------------------------------------------------ answers of any type */

static GC_ERROR give(INFO_DATATYPE type, const void *value, size_t size, INFO_DATATYPE *pType,
                     void *out, size_t *pSize) {
  if (pType) *pType = type;
  if (!pSize) return failed(ERR_INVALID_PARAMETER, "no size");
  if (out && *pSize < size) return failed(ERR_BUFFER_TOO_SMALL, "buffer too small");
  if (out) memcpy(out, value, size);
  *pSize = size;
  return OK;
}

static GC_ERROR give_string(const char *text, INFO_DATATYPE *pType, void *out, size_t *pSize) {
  return give(TYPE_STRING, text, strlen(text) + 1, pType, out, pSize);
}
#define GIVE(name, c_type, code)                                                                  \
  static GC_ERROR name(c_type value, INFO_DATATYPE *pType, void *out, size_t *pSize) {            \
    return give(code, &value, sizeof value, pType, out, pSize);                                   \
  }
GIVE(give_i32, int32_t, TYPE_INT32)
GIVE(give_u32, uint32_t, TYPE_UINT32)
GIVE(give_u64, uint64_t, TYPE_UINT64)
GIVE(give_bool, bool8_t, TYPE_BOOL8)
GIVE(give_size, size_t, TYPE_SIZET)
GIVE(give_ptr, void *, TYPE_PTR)

/* ------------------------------------------------------------------ library */

GC_ERROR GCInitLib(void) {
  if (initialized) return failed(ERR_RESOURCE_IN_USE, "initialized already");
  initialized = 1;
  return OK;
}

GC_ERROR GCCloseLib(void) {
  if (!initialized) return failed(ERR_NOT_INITIALIZED, "not initialized");
  initialized = 0;
  return OK;
}

static GC_ERROR library_info(int32_t cmd, INFO_DATATYPE *pType, void *out, size_t *pSize) {
  switch (cmd) {
  case 0: return give_string(SYSTEM_ID, pType, out, pSize);
  case 1: return give_string("dcam", pType, out, pSize);
  case 2: return give_string("Aravis producer", pType, out, pSize);
  case 3: return give_string("1.0", pType, out, pSize);
  case 4: return give_string("GEV", pType, out, pSize);
  case 5: case 6: return give_string("producer.cti", pType, out, pSize);
  case 7: return give_string("Aravis producer of the tests", pType, out, pSize);
  case 8: return give_i32(0, pType, out, pSize);
  case 9: return give_u32(1, pType, out, pSize);
  case 10: return give_u32(5, pType, out, pSize);
  default: return failed(ERR_NOT_IMPLEMENTED, "no such information");
  }
}

GC_ERROR GCGetInfo(int32_t cmd, INFO_DATATYPE *pType, void *out, size_t *pSize) {
  return library_info(cmd, pType, out, pSize);
}

GC_ERROR GCGetLastError(GC_ERROR *pCode, char *text, size_t *pSize) {
  if (pCode) *pCode = ERR_ERROR;
  return give_string(last_error, NULL, text, pSize);
}

/* ------------------------------------------------------------------ system and interface */

GC_ERROR TLOpen(void **pSystem) { *pSystem = &system_handle; return OK; }
GC_ERROR TLClose(void *system) { (void)system; return OK; }

GC_ERROR TLGetInfo(void *system, int32_t cmd, INFO_DATATYPE *pType, void *out, size_t *pSize) {
  (void)system;
  return library_info(cmd, pType, out, pSize);
}

GC_ERROR TLUpdateInterfaceList(void *system, bool8_t *changed, uint64_t timeout_ms) {
  (void)system; (void)timeout_ms;
  if (changed) *changed = 0;
  return OK;
}

#ifdef BAD_INTERFACE
enum { N_INTERFACES = 2 };
#else
enum { N_INTERFACES = 1 };
#endif
static const char *const BAD_INTERFACE_ID = "dcam-bad-interface";
static Port bad_interface_handle;

GC_ERROR TLGetNumInterfaces(void *system, uint32_t *n) {
  (void)system;
  *n = N_INTERFACES;
  return OK;
}

GC_ERROR TLGetInterfaceID(void *system, uint32_t index, char *id, size_t *pSize) {
  (void)system;
  if (index >= N_INTERFACES) return failed(ERR_INVALID_INDEX, "no such interface");
  return give_string(index ? BAD_INTERFACE_ID : INTERFACE_ID, NULL, id, pSize);
}

static GC_ERROR interface_info(const char *id, int32_t cmd, INFO_DATATYPE *pType, void *out,
                               size_t *pSize) {
  if (cmd == 2) return give_string("GEV", pType, out, pSize);
  if (cmd > 2) return failed(ERR_NOT_IMPLEMENTED, "no such information");
  return give_string(id, pType, out, pSize);
}

GC_ERROR TLGetInterfaceInfo(void *system, const char *id, int32_t cmd, INFO_DATATYPE *pType,
                            void *out, size_t *pSize) {
  (void)system;
  return interface_info(id, cmd, pType, out, pSize);
}

GC_ERROR TLOpenInterface(void *system, const char *id, void **pInterface) {
  (void)system;
  *pInterface = strcmp(id, INTERFACE_ID) == 0 ? &interface_handle : &bad_interface_handle;
  return OK;
}

GC_ERROR IFClose(void *interface) { (void)interface; return OK; }

GC_ERROR IFGetInfo(void *interface, int32_t cmd, INFO_DATATYPE *pType, void *out, size_t *pSize) {
  const char *id = interface == &interface_handle ? INTERFACE_ID : BAD_INTERFACE_ID;
  return interface_info(id, cmd, pType, out, pSize);
}

GC_ERROR IFUpdateDeviceList(void *interface, bool8_t *changed, uint64_t timeout_ms) {
  (void)timeout_ms;
  if (interface == &bad_interface_handle) return failed(ERR_IO, "filter driver not loaded");
  arv_update_device_list();
  if (changed) *changed = 1;
  return OK;
}

/* An entry of the list: a camera of Aravis' list, and under which id it is offered. */
#if defined(TWICE)
static const char *const WAYS[] = {"", ""};
#elif defined(TWO_WAYS)
static const char *const WAYS[] = {"no-way/", ""};
#elif defined(NAMESAKE)
static const char *const WAYS[] = {"", "namesake/"};
#else
static const char *const WAYS[] = {""};
#endif
static const char *const FOREIGN_ID = "foreign";
#ifdef FOREIGN
enum { N_FOREIGN = 1 };
#else
enum { N_FOREIGN = 0 };
#endif

GC_ERROR IFGetNumDevices(void *interface, uint32_t *n) {
  (void)interface;
  *n = N_FOREIGN + G_N_ELEMENTS(WAYS) * arv_get_n_devices();
  return OK;
}

GC_ERROR IFGetDeviceID(void *interface, uint32_t index, char *id, size_t *pSize) {
  uint32_t n;
  IFGetNumDevices(interface, &n);
  if (index >= n) return failed(ERR_INVALID_INDEX, "no such device");
#ifdef BAD_DEVICE
  if (index == n - 1) return failed(ERR_IO, "device does not answer");
#endif
#ifdef FOREIGN
  if (index-- == 0) return give_string(FOREIGN_ID, NULL, id, pSize);
#endif
  char text[256];
  g_snprintf(text, sizeof text, "%s%s", WAYS[index % G_N_ELEMENTS(WAYS)],
             arv_get_device_id(index / G_N_ELEMENTS(WAYS)));
  return give_string(text, NULL, id, pSize);
}

static GC_ERROR device_text(const char *id, const char *vendor, const char *model,
                            const char *serial, int32_t cmd, INFO_DATATYPE *pType, void *out,
                            size_t *pSize) {
  switch (cmd) {
  case 0: case 4: return give_string(id, pType, out, pSize);
  case 1: return give_string(vendor, pType, out, pSize);
  case 2: return give_string(model, pType, out, pSize);
  case 3: return give_string("GEV", pType, out, pSize);
  case 5: return give_i32(1, pType, out, pSize);
  case 7: return give_string(serial, pType, out, pSize);
  case 9: return give_u64(1000000000u, pType, out, pSize);
  default: return failed(ERR_NOT_IMPLEMENTED, "no such information");
  }
}

GC_ERROR IFGetDeviceInfo(void *interface, const char *id, int32_t cmd, INFO_DATATYPE *pType,
                         void *out, size_t *pSize) {
  (void)interface;
  if (strcmp(id, FOREIGN_ID) == 0) {
    if (cmd == 7) return failed(ERR_NOT_AVAILABLE, "serial number not available");
    return device_text(id, "Others", "Gr\374ner frame grabber", "", cmd, pType, out, pSize);
  }
  const char *own_id = strchr(id, '/') ? strchr(id, '/') + 1 : id;
  int namesake = g_str_has_prefix(id, "namesake/");
  for (unsigned i = 0; i < arv_get_n_devices(); i++)
    if (strcmp(arv_get_device_id(i), own_id) == 0)
      return device_text(id, namesake ? "Others" : arv_get_device_vendor(i),
                         namesake ? "CamX" : arv_get_device_model(i),
                         arv_get_device_serial_nbr(i), cmd, pType, out, pSize);
  return failed(ERR_INVALID_ID, "no such device");
}

GC_ERROR IFOpenDevice(void *interface, const char *id, int32_t flags, void **pDevice) {
  (void)interface; (void)flags;
  if (g_str_has_prefix(id, "no-way/")) return failed(ERR_IO, "not reachable by this interface");
  GError *error = NULL;
  ArvCamera *camera = arv_camera_new(id, &error);
  if (!camera) return failed_with(error);
  if (!arv_gv_device_is_controller(ARV_GV_DEVICE(arv_camera_get_device(camera)))) {
    g_object_unref(camera);
    return failed(ERR_ACCESS_DENIED, "another program controls the device");
  }
  Device *device = g_new0(Device, 1);
  device->camera = camera;
  device->remote.kind = REMOTE_PORT;
  device->id = g_strdup(id);
  device->vendor = g_strdup(arv_camera_get_vendor_name(camera, NULL));
  device->model = g_strdup(arv_camera_get_model_name(camera, NULL));
  device->serial = g_strdup(arv_camera_get_device_serial_number(camera, NULL));
  device->buffers = g_ptr_array_new();
  *pDevice = device;
  return OK;
}

/* ------------------------------------------------------------------ device and its port */

GC_ERROR DevGetInfo(Device *device, int32_t cmd, INFO_DATATYPE *pType, void *out, size_t *pSize) {
  return device_text(device->id, device->vendor, device->model, device->serial, cmd, pType, out,
                     pSize);
}

GC_ERROR DevGetPort(Device *device, void **pPort) {
  *pPort = &device->remote;
  return OK;
}

GC_ERROR DevGetNumDataStreams(Device *device, uint32_t *n) { (void)device; *n = 1; return OK; }

GC_ERROR DevGetDataStreamID(Device *device, uint32_t index, char *id, size_t *pSize) {
  (void)device;
  if (index > 0) return failed(ERR_INVALID_INDEX, "one stream only");
  return give_string(STREAM_ID, NULL, id, pSize);
}

GC_ERROR DevOpenDataStream(Device *device, const char *id, void **pStream) {
  (void)id;
  if (device->stream_open) return failed(ERR_RESOURCE_IN_USE, "stream is open");
  device->stream_open = 1;
  *pStream = &device->stream_port;
  return OK;
}

static Device *device_of_stream(void *stream) {
  return (Device *)((char *)stream - offsetof(Device, stream_port));
}

GC_ERROR DSClose(void *stream);

GC_ERROR DevClose(Device *device) {
  if (device->stream_open) DSClose(&device->stream_port);
  g_object_unref(device->camera);
  g_free(device->id);
  g_free(device->vendor);
  g_free(device->model);
  g_free(device->serial);
  g_ptr_array_free(device->buffers, TRUE);
  g_free(device);
  return OK;
}

static ArvDevice *device_of_port(Port *port) {
  return arv_camera_get_device(((Device *)((char *)port - offsetof(Device, remote)))->camera);
}

/* A consumer may ask for the port of a device that it has not opened: then there is none. */
static int has_description(const Port *port) { return port && port->kind == REMOTE_PORT; }

GC_ERROR GCGetPortURL(Port *port, char *url, size_t *pSize) {
  if (!has_description(port)) return failed(ERR_NOT_AVAILABLE, "no description");
  size_t size;
  arv_device_get_genicam_xml(device_of_port(port), &size);
  char text[96];
  g_snprintf(text, sizeof text, "local:camera.xml;%" G_GINT64_MODIFIER "x;%zx", XML_ADDRESS, size);
  return give_string(text, NULL, url, pSize);
}

GC_ERROR GCGetNumPortURLs(Port *port, uint32_t *n) {
  if (!has_description(port)) return failed(ERR_NOT_AVAILABLE, "no description");
  *n = 1;
  return OK;
}

GC_ERROR GCGetPortURLInfo(Port *port, uint32_t index, int32_t cmd, INFO_DATATYPE *pType, void *out,
                          size_t *pSize) {
  if (index > 0 || cmd != 0) return failed(ERR_NOT_AVAILABLE, "only the URL");
  if (pType) *pType = TYPE_STRING;
  return GCGetPortURL(port, out, pSize);
}

GC_ERROR GCGetPortInfo(Port *port, int32_t cmd, INFO_DATATYPE *pType, void *out, size_t *pSize) {
  switch (cmd) {
  case 3: return give_string("GEV", pType, out, pSize);
  case 4: return give_string(has_description(port) ? "TLRemoteDevice" : "TLSystem", pType, out, pSize);
  case 5: case 9: case 10: return give_bool(0, pType, out, pSize);
  case 6: case 7: case 8: return give_bool(1, pType, out, pSize);
  case 12: return give_string("Device", pType, out, pSize);
  default: return give_string("dcam", pType, out, pSize);
  }
}

GC_ERROR GCReadPort(Port *port, uint64_t address, void *out, size_t *pSize) {
  if (!has_description(port)) return failed(ERR_NOT_IMPLEMENTED, "no registers");
  size_t xml_size;
  const char *xml = arv_device_get_genicam_xml(device_of_port(port), &xml_size);
  if (address >= XML_ADDRESS) {
    size_t from = address - XML_ADDRESS;
    if (from + *pSize > xml_size) return failed(ERR_INVALID_PARAMETER, "behind the description");
    memcpy(out, xml + from, *pSize);
    return OK;
  }
  GError *error = NULL;
  if (!arv_device_read_memory(device_of_port(port), address, *pSize, out,
                              &error))
    return failed_with(error);
  return OK;
}

GC_ERROR GCWritePort(Port *port, uint64_t address, const void *data, size_t *pSize) {
  if (!has_description(port)) return failed(ERR_NOT_IMPLEMENTED, "no registers");
  GError *error = NULL;
  if (!arv_device_write_memory(device_of_port(port), address, *pSize,
                               (void *)data, &error))
    return failed_with(error);
  return OK;
}

/* ------------------------------------------------------------------ data stream */

/* The consumer's memory goes through the stream and back, in a new frame of Aravis' each time. */
static void push(Device *device, Buffer *buffer) {
  g_clear_object(&buffer->arv);
  buffer->queued = 1;
  if (device->stream)
    arv_stream_push_buffer(device->stream,
                           arv_buffer_new_full(buffer->size, buffer->data, buffer, NULL));
}

GC_ERROR DSAnnounceBuffer(void *stream, void *data, size_t size, void *user, void **pBuffer) {
  Buffer *buffer = g_new0(Buffer, 1);
  buffer->data = data;
  buffer->size = size;
  buffer->user = user;
  g_ptr_array_add(device_of_stream(stream)->buffers, buffer);
  *pBuffer = buffer;
  return OK;
}

GC_ERROR DSAllocAndAnnounceBuffer(void *stream, size_t size, void *user, void **pBuffer) {
  (void)stream; (void)size; (void)user; (void)pBuffer;
  return failed(ERR_NOT_IMPLEMENTED, "give your own memory");
}

GC_ERROR DSQueueBuffer(void *stream, Buffer *buffer) {
  if (!buffer->queued) push(device_of_stream(stream), buffer);
  return OK;
}

/* The stream lets go of the frames that are in it. */
static void end_stream(Device *device) {
  g_clear_object(&device->stream);
  for (guint i = 0; i < device->buffers->len; i++)
    ((Buffer *)device->buffers->pdata[i])->queued = 0;
}

GC_ERROR DSFlushQueue(void *stream, int32_t operation) {
  (void)operation;
  (void)stream; /* the end of the acquisition has done it */
  return OK;
}

GC_ERROR DSStartAcquisition(void *stream, int32_t flags, uint64_t n) {
  (void)flags; (void)n;
  Device *device = device_of_stream(stream);
  GError *error = NULL;
  device->stream = arv_camera_create_stream(device->camera, NULL, NULL, &error);
  if (!device->stream) return failed_with(error);
  g_object_set(device->stream, "socket-buffer", ARV_GV_STREAM_SOCKET_BUFFER_FIXED,
               "socket-buffer-size", 16 << 20, "packet-resend",
               ARV_GV_STREAM_PACKET_RESEND_ALWAYS, NULL);
  for (guint i = 0; i < device->buffers->len; i++) {
    Buffer *buffer = device->buffers->pdata[i];
    if (buffer->queued) push(device, buffer);
  }
  device->grabbing = 1;
  return OK;
}

GC_ERROR DSStopAcquisition(void *stream, int32_t flags) {
  (void)flags;
  end_stream(device_of_stream(stream));
  device_of_stream(stream)->grabbing = 0;
  return OK;
}

GC_ERROR DSRevokeBuffer(void *stream, Buffer *buffer, void **pData, void **pUser) {
  Device *device = device_of_stream(stream);
  if (device->stream) return failed(ERR_RESOURCE_IN_USE, "acquisition runs");
  if (!g_ptr_array_remove(device->buffers, buffer))
    return failed(ERR_INVALID_HANDLE, "no such buffer");
  if (pData) *pData = buffer->data;
  if (pUser) *pUser = buffer->user;
  g_clear_object(&buffer->arv);
  g_free(buffer);
  return OK;
}

GC_ERROR DSClose(void *stream) {
  Device *device = device_of_stream(stream);
  end_stream(device);
  while (device->buffers->len > 0) DSRevokeBuffer(stream, device->buffers->pdata[0], NULL, NULL);
  device->stream_open = device->grabbing = 0;
  return OK;
}

GC_ERROR DSGetBufferID(void *stream, uint32_t index, void **pBuffer) {
  Device *device = device_of_stream(stream);
  if (index >= device->buffers->len) return failed(ERR_INVALID_INDEX, "no such buffer");
  *pBuffer = device->buffers->pdata[index];
  return OK;
}

GC_ERROR DSGetInfo(void *stream, int32_t cmd, INFO_DATATYPE *pType, void *out, size_t *pSize) {
  Device *device = device_of_stream(stream);
  switch (cmd) {
  case 0: return give_string(STREAM_ID, pType, out, pSize);
  case 1: case 6: return give_u64(device->delivered, pType, out, pSize);
  case 2: return give_u64(0, pType, out, pSize);
  case 3: return give_size(device->buffers->len, pType, out, pSize);
  case 8: return give_bool(device->grabbing, pType, out, pSize);
  case 9: return give_bool(0, pType, out, pSize); /* the camera's PayloadSize says it */
  case 10: return give_string("GEV", pType, out, pSize);
  case 12: return give_size(1, pType, out, pSize);
  default: return failed(ERR_NOT_IMPLEMENTED, "no such information");
  }
}

GC_ERROR DSGetBufferInfo(void *stream, Buffer *buffer, int32_t cmd, INFO_DATATYPE *pType, void *out,
                         size_t *pSize) {
  (void)stream;
  ArvBuffer *arv = buffer->arv;
  switch (cmd) {
  case 0: return give_ptr(buffer->data, pType, out, pSize);
  case 1: return give_size(buffer->size, pType, out, pSize);
  case 2: return give_ptr(buffer->user, pType, out, pSize);
  case 5: return give_bool(buffer->queued, pType, out, pSize);
  case 8: return give_string("GEV", pType, out, pSize);
  }
  if (!arv) return failed(ERR_NOT_AVAILABLE, "the buffer is in the stream");
  switch (cmd) {
  case 3: case 28: return give_u64(arv_buffer_get_timestamp(arv), pType, out, pSize);
  case 4: return give_bool(1, pType, out, pSize);
  case 6: return give_bool(0, pType, out, pSize);
  case 7:
    return give_bool(arv_buffer_get_status(arv) != ARV_BUFFER_STATUS_SUCCESS, pType, out, pSize);
  case 9: case 27: return give_size(buffer->size, pType, out, pSize);
  case 10: return give_size(arv_buffer_get_image_width(arv), pType, out, pSize);
  case 11: case 22: return give_size(arv_buffer_get_image_height(arv), pType, out, pSize);
  case 12: case 13: case 14: case 15: case 18: return give_size(0, pType, out, pSize);
  case 16: return give_u64(arv_buffer_get_frame_id(arv), pType, out, pSize);
  case 17: return give_bool(1, pType, out, pSize);
  case 19: return give_size(1, pType, out, pSize); /* an image */
  case 20: return give_u64(arv_buffer_get_image_pixel_format(arv), pType, out, pSize);
  case 21: return give_u64(4, pType, out, pSize);  /* PFNC, 32 bits */
  default: return failed(ERR_NOT_IMPLEMENTED, "no such information");
  }
}

/* ------------------------------------------------------------------ events */

GC_ERROR GCRegisterEvent(void *source, int32_t type, void **pEvent) {
  if (type != EVENT_NEW_BUFFER) return failed(ERR_NOT_IMPLEMENTED, "new buffers only");
  Device *device = device_of_stream(source);
  if (device->event_registered) return failed(ERR_RESOURCE_IN_USE, "registered already");
  device->event_registered = 1;
  *pEvent = &device->event_registered;
  return OK;
}

GC_ERROR GCUnregisterEvent(void *source, int32_t type) {
  if (type != EVENT_NEW_BUFFER) return failed(ERR_NOT_IMPLEMENTED, "new buffers only");
  device_of_stream(source)->event_registered = 0;
  return OK;
}

static Device *device_of_event(void *event) {
  return (Device *)((char *)event - offsetof(Device, event_registered));
}

GC_ERROR EventGetData(void *event, void *out, size_t *pSize, uint64_t timeout_ms) {
  Device *device = device_of_event(event);
  ArvBuffer *arv = NULL;
  if (!device->stream) {
    g_usleep(1000 * MIN(timeout_ms, 1000));
    return failed(ERR_TIMEOUT, "no acquisition");
  }
  arv = arv_stream_timeout_pop_buffer(device->stream, 1000 * MIN(timeout_ms, 1000000000u));
  if (g_atomic_int_compare_and_exchange(&device->killed, 1, 0)) {
    if (arv) arv_stream_push_buffer(device->stream, arv);
    return failed(ERR_ABORT, "killed");
  }
  if (!arv) return failed(ERR_TIMEOUT, "no frame in time");
  Buffer *buffer = (Buffer *)arv_buffer_get_user_data(arv);
  buffer->arv = arv;
  buffer->queued = 0;
  device->delivered++;
  void *data[2] = {buffer, buffer->user};
  return give(TYPE_PTR, data, sizeof data, NULL, out, pSize);
}

GC_ERROR EventGetDataInfo(void *event, const void *in, size_t in_size, int32_t cmd,
                          INFO_DATATYPE *pType, void *out, size_t *pSize) {
  (void)event;
  if (cmd > 1 || in_size < sizeof(void *)) return failed(ERR_INVALID_PARAMETER, "no such data");
  return give(TYPE_PTR, (const char *)in + (cmd ? sizeof(void *) : 0), sizeof(void *), pType, out,
              pSize);
}

GC_ERROR EventGetInfo(void *event, int32_t cmd, INFO_DATATYPE *pType, void *out, size_t *pSize) {
  Device *device = device_of_event(event);
  gint filled = 0;
  if (device->stream) arv_stream_get_n_buffers(device->stream, NULL, &filled);
  switch (cmd) {
  case 0: return give_i32(EVENT_NEW_BUFFER, pType, out, pSize);
  case 1: return give_size(filled, pType, out, pSize);
  case 2: return give_u64(device->delivered, pType, out, pSize);
  case 3: case 4: return give_size(2 * sizeof(void *), pType, out, pSize);
  default: return failed(ERR_NOT_IMPLEMENTED, "no such information");
  }
}

GC_ERROR EventFlush(void *event) { (void)event; return OK; }

GC_ERROR EventKill(void *event) {
  g_atomic_int_set(&device_of_event(event)->killed, 1);
  return OK;
}

/* ------------------------------------------------------------------ of later versions */

/* A consumer calls some of these without looking whether they are there. */
#define NOT_HERE(name)                                                                            \
  GC_ERROR name(void) { return failed(ERR_NOT_IMPLEMENTED, #name " is not implemented"); }
NOT_HERE(GCReadPortStacked)
NOT_HERE(GCWritePortStacked)
NOT_HERE(IFGetParentTL)
NOT_HERE(DevGetParentIF)
NOT_HERE(DSGetParentDev)
NOT_HERE(DSGetBufferChunkData)
NOT_HERE(DSGetNumBufferParts)
NOT_HERE(DSGetBufferPartInfo)
NOT_HERE(DSAnnounceCompositeBuffer)
NOT_HERE(DSGetNumFlows)
NOT_HERE(DSGetFlowInfo)
NOT_HERE(DSGetNumBufferSegments)
NOT_HERE(DSGetBufferSegmentInfo)
NOT_HERE(DSGetBufferInfoStacked)
NOT_HERE(DSGetBufferPartInfoStacked)
